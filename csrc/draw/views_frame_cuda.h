#pragma once

// Draws the same gaussians from several cameras on a CUDA device, with a backward pass.

#include <memory>
#include <vector>

#include "draw/frame_cuda.h"
#include "project/project_views_backward.h"

namespace v3dg {
namespace cuda {

// Several pictures ("views") of one size. Arrays of gaussians are in device memory, and
// the vectors in host memory.
struct ViewsInput {
    // Either one element for all views, or one for each view. All have the same number
    // of gaussians and the same SH degree.
    std::vector<GaussianRows<const float>> models;
    std::vector<ModelView<float>> views;
    std::vector<FrameImage> images;  // only pinhole cameras; their tiles are numbered
                                     // consecutively
    float filter_px2;
    bool antialiased;
};

// Draws several views in one frame, and computes gradients. The buffers are reused.
class ViewsFrame {
  public:
    ViewsFrame();
    ~ViewsFrame();
    ViewsFrame(const ViewsFrame&) = delete;
    ViewsFrame& operator=(const ViewsFrame&) = delete;

    // Enqueues the pictures. Returns as soon as the buffers are known to suffice.
    // Throws like Drawing::finish().
    void draw(const ViewsInput& in, cudaStream_t stream);

    // Enqueues the backward pass of the last views. It computes the gradients of the
    // gaussians, of the poses, and of the backgrounds (views, 3). Either all or none of
    // `d_pictures` must have depth. If `adds` is true, the gradients are added to the
    // values in `out`. The pictures and the gaussians must not have changed since
    // draw(). Every run gives the same bits.
    void backward(const std::vector<PictureGradient<float>>& d_pictures, const ViewsGradients& out,
                  bool adds, float* d_background, cudaStream_t stream);

  private:
    friend void give_back(std::unique_ptr<ViewsFrame> frame);

    int device_ = 0;
    Frame frame_{Frame::Keeps::tape};
    ViewsInput in_{};
    DeviceBuffer<GaussianRows<const float>> models_;
    DeviceBuffer<Placement> placements_;
    DeviceBuffer<FrameImage> images_;
    unsigned long long num_slots_ = 0;
    cudaEvent_t drawn_ = nullptr, gone_back_ = nullptr;
};

// Returns a frame for the current device. If possible, it is a frame that was given
// back earlier. Do not give back a frame after an error.
std::unique_ptr<ViewsFrame> take_views_frame();
void give_back(std::unique_ptr<ViewsFrame> frame);

// Returns how many views of this size fit into a frame, at least 1.
size_t most_views(size_t num_gaussians, size_t num_pixels);

}  // namespace cuda
}  // namespace v3dg
