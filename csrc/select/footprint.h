#pragma once

// The footprint of a ball, which is the screen area that it covers; and the metric of a
// group, which is footprint times weight.
//
// Decisions depend on every bit of the footprint, so this file is compiled without
// floating-point contraction. The footprint never decreases when a ball grows
// (math/solid_angle.h). A camera contributes a single factor, px2_per_steradian
// (camera/camera.h).

#include <cmath>

#include "math/solid_angle.h"
#include "residency/cluster_table.h"
#include "select/instance_view.h"
#include "select/rule.h"

namespace v3dg {

// Returns the squared distance between an eye and the centre of a ball.
V3DG_HD inline float distance2_from(const float eye[3], const Ball& ball) {
    const float dx = ball.x - eye[0], dy = ball.y - eye[1], dz = ball.z - eye[2];
    return dx * dx + dy * dy + dz * dz;
}
// Returns the squared distance between the nearer eye and the centre of a ball.
V3DG_HD inline float distance2_to(const Ball& ball, const InstanceView& view) {
    const float distance2 = distance2_from(view.eye, ball);
    return view.has_other_eye ? min_of(distance2, distance2_from(view.other_eye, ball)) : distance2;
}

// Returns the screen area, px², of a ball. `distance2` is the squared distance from the
// eye to the ball's centre.
V3DG_HD inline float footprint_at(float radius, float distance2, const InstanceView& view) {
    const float x2 = radius * radius / distance2;
    const float area = solid_angle_of_ball(x2) * view.px2_per_steradian;
    return x2 < 1.0f ? area : INFINITY;
}

// Returns the screen area, px², that a ball covers. It is infinite if the eye is inside
// the ball, or if the computation gives NaN.
V3DG_HD inline float footprint_px2(const Ball& ball, const InstanceView& view,
                                   Footprint footprint) {
    if (footprint == Footprint::solid_angle)
        return footprint_at(ball.radius, distance2_to(ball, view), view);
    const float depth = (ball.x - view.eye[0]) * view.forward[0] +
                        (ball.y - view.eye[1]) * view.forward[1] +
                        (ball.z - view.eye[2]) * view.forward[2];
    const float area =
        float(kPi) * (ball.radius * ball.radius / (depth * depth)) * view.px2_per_steradian;
    return area >= 0.0f ? area : INFINITY;
}

// Returns the metric of group g, as if all pages were resident: the screen area, px²,
// per gaussian of the clusters that the group made. Returns 0 if the rule does not
// allow a finer level, so that the group always fits.
V3DG_HD inline float wanted_metric_px2(const ClusterTable& table, int32_t g,
                                       const InstanceView& view, const SelectRule& rule) {
    const float metric = footprint_px2(table.ball[g], view, rule.footprint) * table.weight[g];
    return table.level[g] <= rule.min_level ? 0.0f : metric;
}

// Returns the metric of group g for the cut. It is 0 if the page with the finer
// clusters is absent, so that the group always fits. Pages above a resident page are
// resident, so this metric does not decrease towards the root either, and the cut stays
// exact.
V3DG_HD inline float metric_px2(const ClusterTable& table, int32_t g, const InstanceView& view,
                                const SelectRule& rule) {
    return table.pages.is_resident(g) ? wanted_metric_px2(table, g, view, rule) : 0.0f;
}

}  // namespace v3dg
