#pragma once

#include <memory>

#include "draw/scene_frame_cuda.h"
#include "project/project_backward.h"

namespace v3dg {
namespace cuda {

// One model in one picture.
struct ModelPicture {
    GaussianRows<const float> rows;
    ModelView<float> view;
    float filter_px2;
    bool antialiased;
    FrameImage image;
};

// Draws a model and computes gradients of the model from those of the picture. It
// reuses its buffers from picture to picture.
class DifferentiableFrame {
  public:
    DifferentiableFrame();
    ~DifferentiableFrame();
    DifferentiableFrame(const DifferentiableFrame&) = delete;
    DifferentiableFrame& operator=(const DifferentiableFrame&) = delete;

    // Returns once it is certain that the picture will be drawn. Throws the exceptions
    // of Drawing::finish().
    void draw(const ModelPicture& in, cudaStream_t stream);

    // Enqueues the gradients of the gaussians and the background (3) of the last
    // picture. Its arrays and the gaussians must be unchanged since draw(). Every
    // element is written; every run gives the same bits.
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

// Returns a frame for the current device, if possible one that was given back with its
// buffers. A caller whose frame failed must not give it back.
std::unique_ptr<DifferentiableFrame> take_frame();
void give_back(std::unique_ptr<DifferentiableFrame> frame);

}  // namespace cuda
}  // namespace v3dg
