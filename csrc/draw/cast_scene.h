#pragma once

// Casts the rays of a spherical sensor through a scene on the CPU. cast_scene_cuda.h
// does the same on CUDA devices.

#include <memory>

#include "draw/scene_frame.h"
#include "rays/rays.h"

namespace v3dg {

// A sensor without a pose. Its axes in view space are x forward, y left and z up. The
// camera that selects its cut must return one over the squared angle between rays from
// px2_per_steradian().
struct RaySensor {
    std::shared_ptr<const RayGrid> grid;
    RayLimits limits;
};

namespace cpu {

// Selects the cut of a sensor, without a frustum, and casts all rays through it.
// `camera` has the sensor's pose and its density of rays. `rule` must not have a
// budget. Returns the number of selected gaussians.
int64_t cast_scene(const HostScene& scene, const RaySensor& sensor, const Camera& camera,
                   SelectRule rule, const RayPlanes& planes);

}  // namespace cpu
}  // namespace v3dg
