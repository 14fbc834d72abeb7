#pragma once

// Casts the rays of a spherical sensor through a scene on the host.

#include "draw/scene_frame.h"
#include "rays/rays.h"

namespace v3dg {

// The sensor: its pose, with x forward, y left and z up in view space, as a camera
// whose px2_per_steradian() is one over the squared spacing of rays; and its rays.
struct RaySensor {
    const Camera& camera;
    const RayGrid& grid;
    RayLimits limits;
};

struct CastCounts {
    int64_t gaussians;    // of the selected clusters
    float tolerance_px2;  // tolerance of the cut
    double select_seconds;
    RayCounts rays;
};

namespace cpu {

// Selects the cut of a sensor, without a frustum, and casts all rays through it. `rule`
// has no budget.
CastCounts cast_scene(const HostScene& scene, const RaySensor& sensor, SelectRule rule,
                      const RayPlanes& planes);

}  // namespace cpu
}  // namespace v3dg
