#pragma once

// Pinhole cameras: the image side that projection needs, and a camera in the world.

#include <cstdint>
#include <cstring>

#include "math/lanes.h"

namespace v3dg {

constexpr double kFovMargin = 0.3;  // of the half field of view: where the Jacobian is clamped

// Image side of a pinhole camera. Pixels; pixel (i, j) has its centre at (i + ½, j + ½).
template <class T>
struct Pinhole {
    T fx, fy, cx, cy;
    T width, height;
    T near_depth;
};

// Model space to view space: view = linear * (model - eye) + translation, linear = uniform scale *
// rotation. What is near the eye keeps its digits, however far from zero both are.
template <class T>
struct ModelView {
    T linear[9];            // row major
    T translation[3];       // of what `eye` lacks
    T eye[3], eye_rest[3];  // the camera's position in model space is their sum
};

// The leading 24 bits of a number, which a float holds. Of its bits, for GCC 12 takes
// (double)(float)x to be x where it vectorizes.
V3DG_HD inline double leading_bits(double x) {
    uint64_t bits;
    std::memcpy(&bits, &x, sizeof bits);
    bits &= ~((uint64_t(1) << 29) - 1);
    std::memcpy(&x, &bits, sizeof bits);
    return x;
}

// Places the eye, in double precision; `translation` is that of view = linear * model +
// translation.
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

// A point of the model in view space.
template <class V, class T>
V3DG_HD V3DG_INLINE void to_view(const ModelView<T>& mv, const V point[3], V p[3]) {
    const V x = point[0] - mv.eye[0], y = point[1] - mv.eye[1], z = point[2] - mv.eye[2];
    for (int i = 0; i < 3; ++i)
        p[i] = mv.linear[3 * i] * x + mv.linear[3 * i + 1] * y + mv.linear[3 * i + 2] * z +
               mv.translation[i];
}

// From the eye to a point, both in the model.
template <class V, class T>
V3DG_HD V3DG_INLINE void from_eye(const ModelView<T>& mv, const V point[3], V direction[3]) {
    for (int k = 0; k < 3; ++k) direction[k] = point[k] - mv.eye[k] - mv.eye_rest[k];
}

// Limits of x / z and y / z past which the Jacobian is held.
template <class T>
struct SlopeLimits {
    T low_x, high_x, low_y, high_y;
};
template <class T>
V3DG_HD V3DG_INLINE SlopeLimits<T> slope_limits(const Pinhole<T>& cam) {
    const T margin_x = T(kFovMargin) * cam.width / (2 * cam.fx);
    const T margin_y = T(kFovMargin) * cam.height / (2 * cam.fy);
    return {-(cam.cx / cam.fx + margin_x), (cam.width - cam.cx) / cam.fx + margin_x,
            -(cam.cy / cam.fy + margin_y), (cam.height - cam.cy) / cam.fy + margin_y};
}

// A pinhole camera in the world, in double precision.
struct Camera {
    double rotation[9];     // world to camera, rows
    double translation[3];  // of world to camera
    double eye[3];
    double fx, fy, cx, cy, width, height, near;  // px; near in world units
    double x0, y0, x1, y1;                       // the part of the image that is wanted, px
};
static_assert(sizeof(Camera) == 26 * sizeof(double), "nothing but its numbers is compared");

// What one cut is for: a camera, or the two eyes of a stereo camera. They look the same way: their
// rotations are equal.
struct Eyes {
    Camera camera[2];  // the same twice where there is one
    bool are_two;

    Eyes() : Eyes(Camera{}) {}
    V3DG_HD Eyes(const Camera& only) : camera{only, only}, are_two(false) {}
    V3DG_HD Eyes(const Camera& left, const Camera& right) : camera{left, right}, are_two(true) {}
    V3DG_HD int count() const { return are_two ? 2 : 1; }
    // Bit by bit.
    bool operator==(const Eyes& other) const {
        return are_two == other.are_two && std::memcmp(camera, other.camera, sizeof camera) == 0;
    }
};

// Where a camera is: what its world-to-camera matrix brings to 0. The rotation in it may be off by
// what float32 loses.
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

// The image side of a camera in the world.
template <class T>
V3DG_HD inline Pinhole<T> pinhole_of(const Camera& c) {
    return {T(c.fx), T(c.fy), T(c.cx), T(c.cy), T(c.width), T(c.height), T(c.near)};
}

// What projection needs of gaussians in the world itself.
template <class T>
V3DG_HD inline ModelView<T> view_of_world(const Camera& c) {
    ModelView<T> view;
    for (int k = 0; k < 9; ++k) view.linear[k] = T(c.rotation[k]);
    set_eye(c.rotation, c.translation, c.eye, view);
    return view;
}

}  // namespace v3dg
