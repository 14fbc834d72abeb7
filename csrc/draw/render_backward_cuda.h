#pragma once

#include <memory>

#include "draw/scene_frame_cuda.h"
#include "project/project_backward.h"

namespace v3dg {
namespace cuda {

// A picture of one model.
struct ModelPicture {
    GaussianRows<const float> rows;
    ModelView<float> view;
    float filter_px2;
    bool antialiased;
    FrameImage image;
};

// Draws pictures of a model, and computes the gradients of its gaussians. The buffers
// are reused from picture to picture.
class DifferentiableFrame {
  public:
    DifferentiableFrame();
    ~DifferentiableFrame();
    DifferentiableFrame(const DifferentiableFrame&) = delete;
    DifferentiableFrame& operator=(const DifferentiableFrame&) = delete;

    // Enqueues a picture. Returns as soon as the buffers are known to suffice. Throws
    // like Drawing::finish().
    void draw(const ModelPicture& in, cudaStream_t stream);

    // Enqueues the backward pass of the last picture. It computes the gradients of the
    // gaussians, of their centres, and of the background (3), and writes every element.
    // The picture and the gaussians must not have changed since draw(). Every run gives
    // the same bits.
    void backward(const PictureGradient<float>& d_picture, const GaussianRows<float>& out,
                  const CenterGradients<float>& centers, float* d_background, cudaStream_t stream);

  private:
    friend void give_back(std::unique_ptr<DifferentiableFrame> frame);

    int device_ = 0;
    ModelFrame frame_;
    ModelPicture in_{};
    unsigned long long num_slots_ = 0;
    cudaEvent_t drawn_ = nullptr, gone_back_ = nullptr;
};

// Returns a frame for the current device. If possible, it is a frame that was returned
// with give_back(). Do not give back a frame after an error.
std::unique_ptr<DifferentiableFrame> take_frame();
void give_back(std::unique_ptr<DifferentiableFrame> frame);

}  // namespace cuda
}  // namespace v3dg
