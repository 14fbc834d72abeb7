#pragma once

// A camera in the world as one instance sees it: composed in double precision, then rounded.

#include <cfloat>

#include "math/quat.h"
#include "project/project_math.h"
#include "select/select_math.h"

namespace v3dg {

// A pinhole camera in the world, in double precision.
struct SelectCamera {
    double rotation[9];  // world to camera, rows
    double eye[3];
    double fx, fy, cx, cy, width, height, near;  // px; near in world units
    double x0, y0, x1, y1;                       // the part of the image that is wanted, px
};

// Where a camera is: what its world-to-camera matrix brings to 0. The rotation in it may be off by what
// float32 loses.
V3DG_HD inline void eye_of(const double viewmat[16], double eye[3]) {
    // The rotation's inverse by columns, which are cross products of its rows.
    double determinant = 0.0;
    for (int a = 0; a < 3; ++a) {
        const int b = (a + 1) % 3, c = (a + 2) % 3;
        eye[a] = 0.0;
        for (int row = 0; row < 3; ++row) {
            const double* next = viewmat + 4 * ((row + 1) % 3);
            const double* after = viewmat + 4 * ((row + 2) % 3);
            const double cofactor = next[b] * after[c] - next[c] * after[b];
            eye[a] -= viewmat[4 * row + 3] * cofactor;
            if (row == 0) determinant += viewmat[a] * cofactor;
        }
    }
    for (int a = 0; a < 3; ++a) eye[a] /= determinant;
}

// A similarity transform p -> scale * rotation p + position.
struct Pose {
    const double* position;    // [3]
    const double* quaternion;  // [4] w x y z, of any length but zero
    double scale;
};

// Whether a pose is one: what is not finite, or of no size, is not drawn.
V3DG_HD inline bool is_placed(const Pose& pose) {
    double sum = pose.scale;
    for (int k = 0; k < 3; ++k) sum += fabs(pose.position[k]);
    double length2 = 0.0;
    for (int k = 0; k < 4; ++k) length2 += pose.quaternion[k] * pose.quaternion[k];
    return pose.scale > 0.0 && sum <= DBL_MAX && length2 > 0.0 && length2 <= DBL_MAX;
}

// The camera in the frame of an instance.
struct InstanceAxes {
    double axes[9], origin[3];  // camera coordinates of an asset's point p, over the scale: axes p + origin
    double eye[3];
};

V3DG_HD inline InstanceAxes axes_of_instance(const SelectCamera& camera, const Pose& pose) {
    const double inverse_scale = 1.0 / pose.scale;
    double rotation[9];
    rotation_of_quat(pose.quaternion, rotation);
    double eye_from_origin[3];
    for (int a = 0; a < 3; ++a) eye_from_origin[a] = camera.eye[a] - pose.position[a];
    InstanceAxes out;
    for (int row = 0; row < 3; ++row) {
        double eye = 0.0, origin = 0.0;
        for (int k = 0; k < 3; ++k) {
            eye += rotation[3 * k + row] * eye_from_origin[k];
            origin -= camera.rotation[3 * row + k] * eye_from_origin[k];
            double axis = 0.0;
            for (int j = 0; j < 3; ++j) axis += camera.rotation[3 * row + j] * rotation[3 * j + k];
            out.axes[3 * row + k] = axis;
        }
        out.origin[row] = origin * inverse_scale;
        // Any eye gives an exact cut as long as squares of distances stay finite.
        out.eye[row] = min_of(max_of(eye * inverse_scale, -1e18), 1e18);
    }
    return out;
}

// What selection needs. Frustum planes lie pad_px outside the part of the image that is wanted.
V3DG_HD inline InstanceView view_from_instance(const SelectCamera& camera, const InstanceAxes& in,
                                               const Pose& pose, float importance, double pad_px) {
    InstanceView view;
    view.px2_per_steradian = static_cast<float>(camera.fx * camera.fy) * importance;
    for (int k = 0; k < 3; ++k) view.eye[k] = static_cast<float>(in.eye[k]);
    for (int k = 0; k < 3; ++k) view.forward[k] = static_cast<float>(in.axes[6 + k]);

    // Outside the near plane: depth < near. Outside a side plane: sign * x > slope * z, or y for x.
    Plane& near = view.plane[0];
    for (int k = 0; k < 3; ++k) near.normal[k] = static_cast<float>(-in.axes[6 + k]);
    near.offset = static_cast<float>(camera.near * (1.0 / pose.scale) - in.origin[2]);
    near.guard = 0.0f;
    for (int side = 0; side < 4; ++side) {
        const bool is_x = side < 2;
        const double sign = side % 2 == 0 ? 1.0 : -1.0;
        const double focal = is_x ? camera.fx : camera.fy;
        const double size = is_x ? camera.width : camera.height;
        const double middle = is_x ? camera.cx : camera.cy;
        const double edge_px = sign > 0 ? size - middle : middle;
        const double wanted_px =
            sign > 0 ? (is_x ? camera.x1 : camera.y1) - middle : middle - (is_x ? camera.x0 : camera.y0);
        const double slope = (wanted_px + pad_px) / focal;
        // The projection is linearised no farther out than this.
        const double linearised = (edge_px + kFovMargin * size / 2) / focal;
        const double* axis = in.axes + (is_x ? 0 : 3);
        Plane& plane = view.plane[1 + side];
        for (int k = 0; k < 3; ++k)
            plane.normal[k] = static_cast<float>(sign * axis[k] - slope * in.axes[6 + k]);
        plane.offset = static_cast<float>(sign * in.origin[is_x ? 0 : 1] - slope * in.origin[2]);
        plane.guard = static_cast<float>(fabs(linearised - slope));
    }
    return view;
}

// What projection needs.
V3DG_HD inline ModelView<float> model_view_from_instance(const InstanceAxes& in, const Pose& pose) {
    ModelView<float> view;
    for (int k = 0; k < 9; ++k) view.linear[k] = static_cast<float>(pose.scale * in.axes[k]);
    for (int k = 0; k < 3; ++k) view.translation[k] = static_cast<float>(pose.scale * in.origin[k]);
    for (int k = 0; k < 3; ++k) view.eye[k] = static_cast<float>(in.eye[k]);
    return view;
}

}  // namespace v3dg
