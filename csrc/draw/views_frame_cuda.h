#pragma once

// Pictures of the same gaussians from several cameras on a CUDA device, and their
// backward pass.

#include <memory>
#include <vector>

#include "draw/frame_cuda.h"
#include "project/project_views_backward.h"

namespace v3dg {
namespace cuda {

// Several pictures ("views") of one size. Arrays of gaussians are on the device, the
// vectors on the host.
struct ViewsInput {
    // The gaussians of all views, or of each view: as many of the same degree.
    std::vector<GaussianRows<const float>> models;
    std::vector<ModelView<float>> views;
    std::vector<FrameImage> images;  // pinholes; their tiles follow each other
    float filter_px2;
    bool antialiased;
};

// Draws views in one frame, and computes gradients. The buffers are reused.
class ViewsFrame {
  public:
    ViewsFrame();
    ~ViewsFrame();
    ViewsFrame(const ViewsFrame&) = delete;
    ViewsFrame& operator=(const ViewsFrame&) = delete;

    // Enqueues the pictures. Returns when it is certain that the buffers suffice.
    // Throws like Drawing::finish().
    void draw(const ViewsInput& in, cudaStream_t stream);

    // Enqueues the backward pass of the last views: the gradients of the gaussians, of
    // the poses, and of the backgrounds (views, 3). Either all or none of `d_pictures`
    // have depth. If `adds`, it adds to the sums that `out` has. The pictures and the
    // gaussians must be unchanged since draw(). The result has the same bits in every
    // run.
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

// Returns a frame for the current device. It reuses a frame of give_back() if there is
// one. A frame must not be given back after an error.
std::unique_ptr<ViewsFrame> take_views_frame();
void give_back(std::unique_ptr<ViewsFrame> frame);

// Returns how many views of this size a frame may have, at least 1.
size_t most_views(size_t num_gaussians, size_t num_pixels);

}  // namespace cuda
}  // namespace v3dg
