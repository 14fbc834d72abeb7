#pragma once

#include <memory>

#include "draw/render_backward_cuda.h"
#include "frame/sensor.h"

namespace v3dg {
namespace cuda {

// Draws pictures of a model with the channels of a sensor. The buffers are reused from
// picture to picture.
class SensingFrame {
  public:
    // Draws a picture, and waits for it. The image has planes.
    std::unique_ptr<Drawing> draw(const ModelPicture& in, float min_transmittance,
                                  const Sensor& sensor, cudaStream_t stream);

  private:
    ModelFrame frame_{Frame::Keeps::tape};
};

}  // namespace cuda
}  // namespace v3dg
