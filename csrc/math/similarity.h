#pragma once

// Poses of instances, and the camera in the coordinates of an instance. They are
// computed in double precision, then rounded. Decisions depend on the results, so
// sources that use these functions are compiled without floating-point contraction.

#include <cfloat>

#include "math/quat.h"
#include "math/view.h"

namespace v3dg {

// A similarity transform p -> scale * rotation p + position.
struct Pose {
    const double* position;    // [3]
    const double* quaternion;  // [4] w x y z, of any nonzero length
    double scale;
};

// Returns whether a pose is valid. It must be finite, with a positive scale and a
// nonzero quaternion. Instances with invalid poses are not drawn.
V3DG_HD inline bool is_placed(const Pose& pose) {
    double sum = pose.scale;
    for (int k = 0; k < 3; ++k) sum += fabs(pose.position[k]);
    bool is_zero = true;
    bool is_finite = true;
    for (int k = 0; k < 4; ++k) {
        is_zero = is_zero && pose.quaternion[k] == 0.0;
        is_finite = is_finite && fabs(pose.quaternion[k]) <= DBL_MAX;
    }
    return pose.scale > 0.0 && sum <= DBL_MAX && !is_zero && is_finite;
}

// A camera in the coordinates of an instance. A point p of the instance is at scale *
// (axes p + origin) in camera coordinates.
struct InstanceAxes {
    double axes[9],
        origin[3];  // camera coordinates of the instance's origin, divided by the scale
    double eye[3];
};

V3DG_HD inline InstanceAxes axes_of_instance(const CameraPose& camera, const Pose& pose) {
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
        // Clamp, so that squared distances are finite. The cut is exact for any
        // position of the eye.
        out.eye[row] = min_of(max_of(eye * inverse_scale, -1e18), 1e18);
    }
    return out;
}

// Returns the transform from the instance's model space to view space.
V3DG_HD inline ModelView<float> model_view_from_instance(const InstanceAxes& in, const Pose& pose) {
    double linear[9], translation[3];
    for (int k = 0; k < 9; ++k) linear[k] = pose.scale * in.axes[k];
    for (int k = 0; k < 3; ++k) translation[k] = pose.scale * in.origin[k];
    ModelView<float> view;
    for (int k = 0; k < 9; ++k) view.linear[k] = static_cast<float>(linear[k]);
    set_eye(linear, translation, in.eye, view);
    return view;
}

}  // namespace v3dg
