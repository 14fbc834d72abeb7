#pragma once

// What selection needs of a camera in the frame of an instance.

#include "math/similarity.h"
#include "select/select_math.h"

namespace v3dg {

// The side planes of a frustum in camera coordinates: right, left, bottom, top. Outside: sign * x >
// slope * z, or y for x. Of two eyes each plane has the larger slope, so that what lies outside it
// as seen from both lies outside of both frusta.
struct FrustumSides {
    double slope[4];
    float guard[4];  // Plane::guard
};

// They lie pad_px outside the part of the image that is wanted.
V3DG_HD inline FrustumSides frustum_sides(const Eyes& eyes, double pad_px) {
    FrustumSides sides;
    for (int side = 0; side < 4; ++side) {
        const bool is_x = side < 2, is_positive = side % 2 == 0;
        double linearised[2];  // the projection is linearised no farther out than this
        for (int k = 0; k < eyes.count(); ++k) {
            const Camera& camera = eyes.camera[k];
            const double focal = is_x ? camera.fx : camera.fy;
            const double size = is_x ? camera.width : camera.height;
            const double middle = is_x ? camera.cx : camera.cy;
            const double edge_px = is_positive ? size - middle : middle;
            const double wanted_px = is_positive ? (is_x ? camera.x1 : camera.y1) - middle
                                                 : middle - (is_x ? camera.x0 : camera.y0);
            linearised[k] = (edge_px + kFovMargin * size / 2) / focal;
            const double slope = (wanted_px + pad_px) / focal;
            sides.slope[side] = k == 0 ? slope : max_of(sides.slope[side], slope);
        }
        double guard = fabs(linearised[0] - sides.slope[side]);
        if (eyes.are_two) guard = max_of(guard, fabs(linearised[1] - sides.slope[side]));
        sides.guard[side] = static_cast<float>(guard);
    }
    return sides;
}

// `in` are the axes of the first eye.
V3DG_HD inline InstanceView view_from_instance(const Eyes& eyes, const FrustumSides& sides,
                                               const InstanceAxes& in, const Pose& pose,
                                               float importance) {
    const Camera& camera = eyes.camera[0];
    double near = camera.near * (1.0 / pose.scale) - in.origin[2], px2 = camera.fx * camera.fy;
    InstanceAxes other = in;
    if (eyes.are_two) {
        const Camera& second = eyes.camera[1];
        other = axes_of_instance(second, pose);
        near = min_of(near, second.near * (1.0 / pose.scale) - other.origin[2]);
        px2 = max_of(px2, second.fx * second.fy);
    }
    InstanceView view;
    view.px2_per_steradian = static_cast<float>(px2) * importance;
    view.has_other_eye = eyes.are_two;
    for (int k = 0; k < 3; ++k) view.eye[k] = static_cast<float>(in.eye[k]);
    for (int k = 0; k < 3; ++k) view.other_eye[k] = static_cast<float>(other.eye[k]);
    for (int k = 0; k < 3; ++k) view.forward[k] = static_cast<float>(in.axes[6 + k]);

    // Outside the near plane: depth < near.
    Plane& front = view.plane[0];
    for (int k = 0; k < 3; ++k) front.normal[k] = static_cast<float>(-in.axes[6 + k]);
    front.offset = static_cast<float>(near);
    front.guard = 0.0f;
    for (int side = 0; side < 4; ++side) {
        const double sign = side % 2 == 0 ? 1.0 : -1.0, slope = sides.slope[side];
        const double* axis = in.axes + (side < 2 ? 0 : 3);
        Plane& plane = view.plane[1 + side];
        for (int k = 0; k < 3; ++k)
            plane.normal[k] = static_cast<float>(sign * axis[k] - slope * in.axes[6 + k]);
        const int across = side < 2 ? 0 : 1;
        plane.offset =
            static_cast<float>(min_of(sign * in.origin[across] - slope * in.origin[2],
                                      sign * other.origin[across] - slope * other.origin[2]));
        plane.guard = sides.guard[side];
    }
    return view;
}

}  // namespace v3dg
