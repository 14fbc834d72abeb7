#pragma once

// Casts the rays of a spherical sensor through a scene: the sensor, and the function of
// the host. cast_scene_cuda.h has that of CUDA devices.

#include <memory>

#include "draw/scene_frame.h"
#include "rays/rays.h"

namespace v3dg {

// A sensor without a pose. Its pose has x forward, y left and z up in view space. The
// camera that selects its cuts has one over the squared spacing of rays as
// px2_per_steradian().
struct RaySensor {
    std::shared_ptr<const RayGrid> grid;
    RayLimits limits;
};

namespace cpu {

// Selects the cut of a sensor, without a frustum, and casts all rays through it. The
// camera has the pose of the sensor, and its density. `rule` has no budget. Returns the
// number of selected gaussians.
int64_t cast_scene(const HostScene& scene, const RaySensor& sensor, const Camera& camera,
                   SelectRule rule, const RayPlanes& planes);

}  // namespace cpu
}  // namespace v3dg
