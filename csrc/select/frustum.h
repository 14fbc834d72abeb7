#pragma once

// Culling: tests whether boxes are outside of a camera's frustum.

#include <cfloat>
#include <cmath>

#include "math/bounds.h"
#include "select/instance_view.h"

namespace v3dg {

// The position of a box relative to a plane, in units of the length of the plane's
// normal.
struct PlaneSide {
    float nearest, farthest;  // signed distances of the nearest and the farthest corner
    // How far gaussians may extend beyond the box, plus a margin for rounding.
    float reach;
};

V3DG_HD inline PlaneSide side_of(const Box& box, const InstanceView& view, int p) {
    const Plane& plane = view.plane[p];
    float middle = plane.offset, spread = 0.0f, terms = fabsf(plane.offset), half_depth = 0.0f;
    for (int a = 0; a < 3; ++a) {
        const float center = 0.5f * box.lo[a] + 0.5f * box.hi[a];
        const float half = 0.5f * box.hi[a] - 0.5f * box.lo[a];
        middle += plane.normal[a] * center;
        spread += fabsf(plane.normal[a]) * half;
        terms += fabsf(plane.normal[a]) * (fabsf(center) + half);
        half_depth += fabsf(view.forward[a]) * half;
    }
    return {middle - spread, middle + spread,
            plane.guard * half_depth + 16.0f * FLT_EPSILON * terms};
}

// Returns true only if no gaussian in the box can touch a pixel. NaN gives false.
V3DG_HD inline bool is_outside(const Box& box, const InstanceView& view) {
    for (int p = 0; p < kNumPlanes; ++p) {
        const PlaneSide side = side_of(box, view, p);
        if (side.nearest > side.reach) return true;
    }
    return false;
}

// Returns true only if is_outside() is false for every box inside this one. NaN gives
// false.
V3DG_HD inline bool is_inside(const Box& box, const InstanceView& view) {
    for (int p = 0; p < kNumPlanes; ++p) {
        const PlaneSide side = side_of(box, view, p);
        if (!(side.farthest + side.reach < 0.0f)) return false;
    }
    return true;
}

}  // namespace v3dg
