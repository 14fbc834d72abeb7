#pragma once

// Makes pinhole cameras from the numbers of their poses and intrinsics, on the host and
// on a device. Sources that call these functions are compiled without floating-point
// contraction, so that the host and a device compute the same bits.

#include <cfloat>

#include "camera/camera.h"

namespace v3dg {

// How much the rows of a rotation may differ from orthonormal rows. Matrices that were
// stored as float32 differ a little.
constexpr double kRotationTolerance = 1e-4;

// The reason why numbers are not a valid camera.
enum class CameraFault : int32_t { none, not_finite, no_rotation, last_row, focal_length, skew };

// Returns whether a 3x3 matrix is a rotation. Its rows are `stride` apart. If any
// number is NaN, returns false.
V3DG_HD inline bool is_rotation(const double* m, int stride) {
    const double *x = m, *y = m + stride, *z = m + 2 * stride;
    const auto dot = [](const double* a, const double* b) {
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    };
    const double deviations[6] = {dot(x, x) - 1, dot(y, y) - 1, dot(z, z) - 1,
                                  dot(x, y),     dot(x, z),     dot(y, z)};
    bool is_orthonormal = true;
    for (const double deviation : deviations)
        is_orthonormal = is_orthonormal && fabs(deviation) <= kRotationTolerance;
    const double determinant = x[0] * (y[1] * z[2] - y[2] * z[1]) -
                               x[1] * (y[0] * z[2] - y[2] * z[0]) +
                               x[2] * (y[0] * z[1] - y[1] * z[0]);
    return is_orthonormal && determinant > 0;
}

// Returns what is wrong with a (4, 4) world-to-camera matrix, or with a (3, 3) matrix
// of intrinsics in px.
V3DG_HD inline CameraFault fault_of_camera(const double viewmat[16], const double K[9]) {
    bool is_finite = true;
    for (int k = 0; k < 16; ++k) is_finite = is_finite && fabs(viewmat[k]) <= DBL_MAX;
    for (int k = 0; k < 9; ++k) is_finite = is_finite && fabs(K[k]) <= DBL_MAX;
    if (!is_finite) return CameraFault::not_finite;
    if (!is_rotation(viewmat, 4)) return CameraFault::no_rotation;
    if (viewmat[12] != 0 || viewmat[13] != 0 || viewmat[14] != 0 || viewmat[15] != 1)
        return CameraFault::last_row;
    if (!(K[0] > 0 && K[4] > 0)) return CameraFault::focal_length;
    const bool is_plain = K[1] == 0 && K[3] == 0 && K[6] == 0 && K[7] == 0 && K[8] == 1;
    return is_plain ? CameraFault::none : CameraFault::skew;
}

// Returns the camera with this pose and these intrinsics. It draws its whole image.
V3DG_HD inline Camera camera_of(const double viewmat[16], const double K[9], int width, int height,
                                double near_depth) {
    Camera camera{};
    for (int row = 0; row < 3; ++row) {
        for (int a = 0; a < 3; ++a) camera.rotation[3 * row + a] = viewmat[4 * row + a];
        camera.translation[row] = viewmat[4 * row + 3];
    }
    eye_of(viewmat, camera.eye);
    camera.fx = K[0];
    camera.fy = K[4];
    camera.cx = K[2];
    camera.cy = K[5];
    camera.width = width;
    camera.height = height;
    camera.near_depth = near_depth;
    camera.x0 = camera.y0 = 0;
    camera.x1 = width;
    camera.y1 = height;
    return camera;
}

}  // namespace v3dg
