#pragma once

// The footprint of a ball on the screen, and the metric of a group, which is its
// footprint times its weight.
//
// Decisions depend on every bit of the footprint, so this code is compiled without
// contraction. The footprint never decreases when a ball grows (math/solid_angle.h).
// The density px2_per_steradian is one number per camera: an upper bound over any ball
// (camera/camera.h).

#include <cmath>

#include "math/solid_angle.h"
#include "residency/cluster_table.h"
#include "select/instance_view.h"
#include "select/rule.h"

namespace v3dg {

// Squared distance of the ball's centre from an eye.
V3DG_HD inline float distance2_from(const float eye[3], const Ball& ball) {
    const float dx = ball.x - eye[0], dy = ball.y - eye[1], dz = ball.z - eye[2];
    return dx * dx + dy * dy + dz * dz;
}
// Squared distance of the ball's centre from the nearer eye.
V3DG_HD inline float distance2_to(const Ball& ball, const InstanceView& view) {
    const float distance2 = distance2_from(view.eye, ball);
    return view.has_other_eye ? min_of(distance2, distance2_from(view.other_eye, ball)) : distance2;
}

// The screen area, px2, of a ball whose centre is at this squared distance from the
// eye.
V3DG_HD inline float footprint_at(float radius, float distance2, const InstanceView& view) {
    const float x2 = radius * radius / distance2;
    const float area = solid_angle_of_ball(x2) * view.px2_per_steradian;
    return x2 < 1.0f ? area : INFINITY;
}

// The screen area that the ball covers, px2; +inf if the eye is inside or the result
// would be NaN.
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

// The metric of group g if all pages were resident: the screen area, px2, per gaussian
// of the clusters that the group made. It is 0 if nothing finer may be drawn, so that
// the group always fits.
V3DG_HD inline float wanted_metric_px2(const ClusterTable& table, int32_t g,
                                       const InstanceView& view, const SelectRule& rule) {
    const float metric = footprint_px2(table.ball[g], view, rule.footprint) * table.weight[g];
    return table.level[g] <= rule.min_level ? 0.0f : metric;
}

// The metric that the cut compares. It is 0 also where the finer clusters are not
// resident. The groups that are wanted and the groups that are resident are both closed
// towards the root, so their intersection is closed, too, and the cut stays exact.
V3DG_HD inline float metric_px2(const ClusterTable& table, int32_t g, const InstanceView& view,
                                const SelectRule& rule) {
    return table.pages.is_resident(g) ? wanted_metric_px2(table, g, view, rule) : 0.0f;
}

}  // namespace v3dg
