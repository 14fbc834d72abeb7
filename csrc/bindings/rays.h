#pragma once

// The interface of backends for casting rays (see backend.h).

#include <memory>
#include <vector>

#include "bindings/batch.h"
#include "bindings/resident.h"
#include "draw/cast_scene.h"

namespace v3dg::backend {

// The inputs of a cast. The bindings have checked that they fit each other.
struct CastInput {
    const RaySensor& sensor;
    Reals viewmats;  // (B, 4, 4) from the world to the sensor
    size_t num_poses;
    // (B,) int32 on the host; null if the sensors see all instances
    Wholes environments;
    SelectRule rule;  // without a budget; not used for an asset
    // The planes of all poses follow each other.
    RayPlanes planes;
};

// Casts the rays of sensors through scenes of the same bundles, or through assets. Its
// functions are called without the GIL, by any thread, and return the number of
// selected gaussians at each pose.
class RayFrame {
  public:
    virtual ~RayFrame() = default;
    // Sets the model of each bundle, and shares ownership of them. Called with the GIL.
    virtual void set_models(std::vector<std::shared_ptr<const Model>> models, const Work& work) = 0;
    virtual std::vector<int64_t> cast_scene(const Scene& scene, const SceneState& state,
                                            const CastInput& input, const Work& work) = 0;
    // The model has rows.
    virtual std::vector<int64_t> cast_model(const Model& model, const Appearance<float>& appearance,
                                            const CastInput& input, const Work& work) = 0;
};

}  // namespace v3dg::backend
