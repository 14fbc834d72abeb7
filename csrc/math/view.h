#pragma once

// The pose of a camera in the world, and the transform from model space to view space.
// Neither depends on the camera model (camera/camera.h).

#include <cstdint>
#include <cstring>

#include "base/host_device.h"

namespace v3dg {

// The position and orientation of a camera in the world, in double precision.
struct CameraPose {
    double rotation[9];     // from world to camera, row major
    double translation[3];  // from world to camera
    double eye[3];          // position of the camera in the world
};

// The transform from model space to view space: linear * (point - eye) + translation,
// where `linear` is a rotation times a uniform scale. Subtracting the eye first
// preserves the precision of nearby points, even far from the origin.
template <class T>
struct ModelView {
    T linear[9];            // row major
    T translation[3];       // corrects the rounding of `eye`, in view space
    T eye[3], eye_rest[3];  // the position of the camera in model space is eye +
                            // eye_rest
};

// Returns the leading 24 bits of a number, which a float can represent. The other bits
// are masked instead of converting to float and back, because GCC 12 replaces
// (double)(float)x by x in vectorised code.
V3DG_HD inline double leading_bits(double x) {
    uint64_t bits;
    std::memcpy(&bits, &x, sizeof bits);
    bits &= ~((uint64_t(1) << 29) - 1);
    std::memcpy(&x, &bits, sizeof bits);
    return x;
}

// Sets the eye and the translation of a view. `translation` is the t of the transform
// linear * point + t.
template <class T>
V3DG_HD inline void set_eye(const double linear[9], const double translation[3],
                            const double eye[3], ModelView<T>& view) {
    double rest[3] = {translation[0], translation[1], translation[2]};
    for (int k = 0; k < 3; ++k) {
        const double leading = leading_bits(eye[k]);
        view.eye[k] = T(leading);
        view.eye_rest[k] = T(eye[k] - leading);
        for (int row = 0; row < 3; ++row) rest[row] += linear[3 * row + k] * leading;
    }
    for (int row = 0; row < 3; ++row) view.translation[row] = T(rest[row]);
}

// Transforms a point from model space to view space.
template <class V, class T>
V3DG_HD V3DG_INLINE void to_view(const ModelView<T>& mv, const V point[3], V p[3]) {
    const V x = point[0] - mv.eye[0], y = point[1] - mv.eye[1], z = point[2] - mv.eye[2];
    for (int i = 0; i < 3; ++i)
        p[i] = mv.linear[3 * i] * x + mv.linear[3 * i + 1] * y + mv.linear[3 * i + 2] * z +
               mv.translation[i];
}

// Computes the vector from the eye to a point, in model space.
template <class V, class T>
V3DG_HD V3DG_INLINE void from_eye(const ModelView<T>& mv, const V point[3], V direction[3]) {
    for (int k = 0; k < 3; ++k) direction[k] = point[k] - mv.eye[k] - mv.eye_rest[k];
}

// Computes the position of a camera, which its world-to-camera matrix maps to 0. The
// rotation may have rounding errors of float32.
V3DG_HD inline void eye_of(const double viewmat[16], double eye[3]) {
    // The columns of the inverse are cross products of the rows, divided by the
    // determinant.
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

// Returns the view of gaussians in world space.
template <class T>
V3DG_HD inline ModelView<T> view_of_world(const CameraPose& pose) {
    ModelView<T> view;
    for (int k = 0; k < 9; ++k) view.linear[k] = T(pose.rotation[k]);
    set_eye(pose.rotation, pose.translation, pose.eye, view);
    return view;
}

}  // namespace v3dg
