#pragma once

// Rotations from quaternions (w, x, y, z) of any length but zero.

#include "math/lanes.h"

namespace v3dg {

// Rotation matrix, row major, of a quaternion of which 2 over its squared length is `s`.
template <class V>
V3DG_HD V3DG_INLINE void rotation_of_quat(const V q[4], V s, V r[9]) {
    const V w = q[0], x = q[1], y = q[2], z = q[3];
    r[0] = 1 - s * (y * y + z * z);
    r[1] = s * (x * y - w * z);
    r[2] = s * (x * z + w * y);
    r[3] = s * (x * y + w * z);
    r[4] = 1 - s * (x * x + z * z);
    r[5] = s * (y * z - w * x);
    r[6] = s * (x * z - w * y);
    r[7] = s * (y * z + w * x);
    r[8] = 1 - s * (x * x + y * y);
}

// That of the normalised quaternion. A zero quaternion gives the identity.
template <class V>
V3DG_HD V3DG_INLINE void rotation_of_quat(const V q[4], V r[9]) {
    const V n2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    const V s = n2 > V{} ? 2 / n2 : V{};
    rotation_of_quat(q, s, r);
}

// Gradient of the quaternion, through its normalisation, from that of the rotation matrix.
template <class V>
V3DG_HD V3DG_INLINE void rotation_of_quat_vjp(const V q[4], const V g[9], V g_q[4]) {
    const V n2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
    const V s = n2 > V{} ? 2 / n2 : V{};
    const V w = q[0], x = q[1], y = q[2], z = q[3];
    const V d_w = s * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]));
    const V d_x = s * (y * (g[1] + g[3]) + z * (g[2] + g[6]) + w * (g[7] - g[5]) - 2 * x * (g[4] + g[8]));
    const V d_y = s * (x * (g[1] + g[3]) + z * (g[5] + g[7]) + w * (g[2] - g[6]) - 2 * y * (g[0] + g[8]));
    const V d_z = s * (x * (g[2] + g[6]) + y * (g[5] + g[7]) + w * (g[3] - g[1]) - 2 * z * (g[0] + g[4]));
    // The matrix does not change with the length of the quaternion, so the gradient is orthogonal to it.
    const V along = (w * d_w + x * d_x + y * d_y + z * d_z) * (s / 2);
    g_q[0] = d_w - along * w;
    g_q[1] = d_x - along * x;
    g_q[2] = d_y - along * y;
    g_q[3] = d_z - along * z;
}

}  // namespace v3dg
