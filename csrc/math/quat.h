#pragma once

// Rotations by quaternions (w, x, y, z) of any nonzero length. A quaternion that is not
// finite gives a matrix of NaN.

#include "math/lanes.h"

namespace v3dg {

// The range of squared lengths that are computed without underflow or overflow. Any
// other quaternion, down to the smallest denormal numbers, can be multiplied by `up` or
// `down` to bring its length into the range. Both are powers of two, so nothing is
// rounded.
template <class T>
struct QuatRange {
    static constexpr T least2 = T(0x1p-80), most2 = T(0x1p100), up = T(0x1p100), down = T(0x1p-100);
};
template <>
struct QuatRange<double> {
    static constexpr double least2 = 0x1p-600, most2 = 0x1p700, up = 0x1p800, down = 0x1p-600;
};

template <class V>
V3DG_HD V3DG_INLINE V length2_of_quat(const V q[4]) {
    return q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
}

// Returns whether a squared length is out of this range. Returns false for NaN.
template <class V>
V3DG_HD V3DG_INLINE auto is_out_of_range(V length2) {
    using Range = QuatRange<Lane<V>>;
    return (length2 < all_lanes<V>(Range::least2)) | (length2 > all_lanes<V>(Range::most2));
}

// If the squared length of a quaternion is out of range, multiplies the quaternion by a
// power of two that brings it into range. Returns that factor, or 1.
template <class V>
V3DG_HD V3DG_INLINE V bring_into_range(V q[4]) {
    using Range = QuatRange<Lane<V>>;
    const V length2 = length2_of_quat(q), one = all_lanes<V>(Lane<V>(1));
    const V up = length2 < all_lanes<V>(Range::least2) ? all_lanes<V>(Range::up) : one;
    const V factor = length2 > all_lanes<V>(Range::most2) ? all_lanes<V>(Range::down) : up;
    for (int k = 0; k < 4; ++k) q[k] *= factor;
    return factor;
}

// Normalises a quaternion. A zero quaternion becomes the identity.
template <class T>
V3DG_HD V3DG_INLINE void normalise_quat(T q[4]) {
    if (is_out_of_range(length2_of_quat(q))) bring_into_range(q);
    const T length2 = length2_of_quat(q);
    const T length = sqrt_of(length2);
    for (int k = 0; k < 4; ++k) q[k] = length2 == 0 ? static_cast<T>(k == 0) : q[k] / length;
}

// Rounds a quaternion to float32. If its squared length is out of the range of float32,
// it is normalised first.
V3DG_HD V3DG_INLINE void round_quat(double q[4], float out[4]) {
    const double length2 = length2_of_quat(q);
    const bool is_held = length2 >= QuatRange<float>::least2 && length2 <= QuatRange<float>::most2;
    if (!is_held && length2 != 0) normalise_quat(q);
    for (int k = 0; k < 4; ++k) out[k] = static_cast<float>(q[k]);
}

// Computes the row-major rotation matrix of a quaternion. `s` is 2 / squared length.
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

// Computes the row-major rotation matrix of a quaternion of any length. Lanes with
// lengths out of range are rare; they are computed a second time. The other lanes keep
// their first result, so that the rounding in a lane does not depend on other lanes.
template <class V>
V3DG_HD V3DG_INLINE void rotation_of_quat(const V q[4], V r[9]) {
    const V n2 = length2_of_quat(q);
    const V s = n2 > V{} ? 2 / n2 : V{};
    rotation_of_quat(q, s, r);
    const auto is_again = is_out_of_range(n2);
    if (is_any(is_again)) {
        V p[4] = {q[0], q[1], q[2], q[3]};
        bring_into_range(p);
        const V p2 = length2_of_quat(p);
        const V of_p = p2 > V{} ? 2 / p2 : V{};
        V again[9];
        rotation_of_quat(p, of_p, again);
        for (int k = 0; k < 9; ++k) r[k] = is_again ? again[k] : r[k];
    }
}

// Computes the gradient of a quaternion from the gradient of its rotation matrix.
// Precondition: the squared length `n2` is in range.
template <class V>
V3DG_HD V3DG_INLINE void rotation_of_quat_in_range_vjp(const V q[4], V n2, const V g[9], V g_q[4]) {
    const V s = n2 > V{} ? 2 / n2 : V{};
    const V w = q[0], x = q[1], y = q[2], z = q[3];
    const V d_w = s * (x * (g[7] - g[5]) + y * (g[2] - g[6]) + z * (g[3] - g[1]));
    const V d_x =
        s * (y * (g[1] + g[3]) + z * (g[2] + g[6]) + w * (g[7] - g[5]) - 2 * x * (g[4] + g[8]));
    const V d_y =
        s * (x * (g[1] + g[3]) + z * (g[5] + g[7]) + w * (g[2] - g[6]) - 2 * y * (g[0] + g[8]));
    const V d_z =
        s * (x * (g[2] + g[6]) + y * (g[5] + g[7]) + w * (g[3] - g[1]) - 2 * z * (g[0] + g[4]));
    // The matrix does not depend on the length of the quaternion. Therefore the
    // component of the gradient along the quaternion is removed.
    const V along = (w * d_w + x * d_x + y * d_y + z * d_z) * (s / 2);
    g_q[0] = d_w - along * w;
    g_q[1] = d_x - along * x;
    g_q[2] = d_y - along * y;
    g_q[3] = d_z - along * z;
}

// Like rotation_of_quat_in_range_vjp(), but for quaternions of any length. The gradient
// is proportional to 1 / length, up to the largest float.
template <class V>
V3DG_HD V3DG_INLINE void rotation_of_quat_vjp(const V q[4], const V g[9], V g_q[4]) {
    const V n2 = length2_of_quat(q);
    rotation_of_quat_in_range_vjp(q, n2, g, g_q);
    const auto is_again = is_out_of_range(n2);
    if (is_any(is_again)) {
        using T = Lane<V>;
        V p[4] = {q[0], q[1], q[2], q[3]};
        const V factor = bring_into_range(p);
        V again[4];
        rotation_of_quat_in_range_vjp(p, length2_of_quat(p), g, again);
        for (int k = 0; k < 4; ++k) {
            const V finite = cut_to(-kLargest<T>, kLargest<T>, again[k] * factor);
            g_q[k] = is_again ? finite : g_q[k];
        }
    }
}

}  // namespace v3dg
