#pragma once

// What selection needs of a camera in the frame of an instance.

#include "math/similarity.h"
#include "select/select_math.h"

namespace v3dg {

// The side planes of a frustum in camera coordinates: right, left, bottom, top. Outside: sign * x > slope *
// z, or y for x.
struct FrustumSides {
    double slope[4];
    float guard[4];  // Plane::guard
};

// They lie pad_px outside the part of the image that is wanted.
V3DG_HD inline FrustumSides frustum_sides(const Camera& camera, double pad_px) {
    FrustumSides sides;
    for (int side = 0; side < 4; ++side) {
        const bool is_x = side < 2, is_positive = side % 2 == 0;
        const double focal = is_x ? camera.fx : camera.fy;
        const double size = is_x ? camera.width : camera.height;
        const double middle = is_x ? camera.cx : camera.cy;
        const double edge_px = is_positive ? size - middle : middle;
        const double wanted_px =
            is_positive ? (is_x ? camera.x1 : camera.y1) - middle : middle - (is_x ? camera.x0 : camera.y0);
        // The projection is linearised no farther out than this.
        const double linearised = (edge_px + kFovMargin * size / 2) / focal;
        sides.slope[side] = (wanted_px + pad_px) / focal;
        sides.guard[side] = static_cast<float>(fabs(linearised - sides.slope[side]));
    }
    return sides;
}

V3DG_HD inline InstanceView view_from_instance(const Camera& camera, const FrustumSides& sides,
                                               const InstanceAxes& in, const Pose& pose, float importance) {
    InstanceView view;
    view.px2_per_steradian = static_cast<float>(camera.fx * camera.fy) * importance;
    for (int k = 0; k < 3; ++k) view.eye[k] = static_cast<float>(in.eye[k]);
    for (int k = 0; k < 3; ++k) view.forward[k] = static_cast<float>(in.axes[6 + k]);

    // Outside the near plane: depth < near.
    Plane& near = view.plane[0];
    for (int k = 0; k < 3; ++k) near.normal[k] = static_cast<float>(-in.axes[6 + k]);
    near.offset = static_cast<float>(camera.near * (1.0 / pose.scale) - in.origin[2]);
    near.guard = 0.0f;
    for (int side = 0; side < 4; ++side) {
        const double sign = side % 2 == 0 ? 1.0 : -1.0, slope = sides.slope[side];
        const double* axis = in.axes + (side < 2 ? 0 : 3);
        Plane& plane = view.plane[1 + side];
        for (int k = 0; k < 3; ++k)
            plane.normal[k] = static_cast<float>(sign * axis[k] - slope * in.axes[6 + k]);
        plane.offset = static_cast<float>(sign * in.origin[side < 2 ? 0 : 1] - slope * in.origin[2]);
        plane.guard = sides.guard[side];
    }
    return view;
}

}  // namespace v3dg
