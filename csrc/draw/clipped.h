#pragma once

// The channel `clipped` on CUDA: marks the pixels in which a gaussian is missing
// because its mean is before the near plane. A frame has left out such gaussians, so
// the cut of each picture is computed again without culling.

#include "project/project_cuda.h"
#include "rasterize/sense.h"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

// The pictures of a frame, all of one size, each with a cut of its own.
struct ClippedPictures {
    FrameSensors sensors;
    // The cameras of a batch, on the device; null if `eye` has the cameras.
    const BatchCamera* cameras = nullptr;
    Camera eye[2] = {};
    uint32_t count = 0;
    int width = 0, height = 0;

    bool is_on() const { return sensors.wants_clipped(); }
};

// The gaussians of the models that a frame draws, as in ProjectInput.
struct DrawnModels {
    const GaussianRows<const float>* rows;
    const PackedPlanes* packed;
    const CodedGaussians* coded;
};

// Marks clipped pixels. It owns the scratch memory of its cuts. Works on the device
// that is current at construction, and does not wait.
class ClippedPass {
  public:
    // Marks pictures of a scene. `seen` are bounds on what one camera sees. If `choice`
    // is not null, it has the tolerance of the rule, on the device.
    void mark_scene(const SceneTables& scene, const SeenBounds& seen,
                    const ClippedPictures& pictures, const DrawnModels& models, SelectRule rule,
                    const CutChoice* choice, cudaStream_t stream,
                    const PartlyResident* resident = nullptr);
    // Marks the picture of a cut that was selected earlier.
    void mark_given(const SceneTables& scene, const ClippedPictures& pictures,
                    const DrawnModels& models, const GivenCut& given, cudaStream_t stream) const;
    // Marks the picture of an asset with `count` gaussians, which is model 0.
    static void mark_model(const ClippedPictures& pictures, const DrawnModels& models,
                           const ModelView<float>& view, size_t count, cudaStream_t stream);

    size_t bytes() const;

  private:
    const int device_ = current_device();
    DeviceBuffer<InstanceView> views_;
    DeviceBuffer<uint8_t> tops_;
    DeviceBuffer<int32_t> bundle_of_place_;
    DeviceBuffer<float> opacity_;  // factor of each place
    DeviceBuffer<Placement> placements_;
    DeviceBuffer<CutPart> parts_;
    DeviceBuffer<unsigned long long> zeros_, states_;
};

}  // namespace cuda
}  // namespace v3dg
