#pragma once

// Real spherical harmonics of degrees 0 to 3, with the order and signs that .ply files
// use. The colour of a gaussian is max(0, 1/2 + sum of coefficient * basis(view
// direction)).

#include "math/vec.h"

namespace v3dg {

constexpr int kMaxShDegree = 3, kMaxShBases = 16;
constexpr double kShBase0 = 0.28209479177387814;  // the constant basis of degree 0
// The degree of plain colours, which are three numbers (possibly negative) instead of
// coefficients.
constexpr int kPlainColor = -1;

V3DG_HD constexpr int num_sh_bases(int degree) {
    return degree == kPlainColor ? 1 : (degree + 1) * (degree + 1);
}

// Computes the bases for the unit direction (x, y, z).
template <class V>
V3DG_HD V3DG_INLINE void sh_bases(int degree, V x, V y, V z, V basis[kMaxShBases]) {
    using T = Lane<V>;
    basis[0] = all_lanes<V>(T(kShBase0));
    if (degree < 1) return;
    const T c1 = T(0.4886025119029199);
    basis[1] = -c1 * y;
    basis[2] = c1 * z;
    basis[3] = -c1 * x;
    if (degree < 2) return;
    const V xx = x * x, yy = y * y, zz = z * z;
    basis[4] = T(1.0925484305920792) * x * y;
    basis[5] = T(-1.0925484305920792) * y * z;
    basis[6] = T(0.31539156525252005) * (2 * zz - xx - yy);
    basis[7] = T(-1.0925484305920792) * x * z;
    basis[8] = T(0.5462742152960396) * (xx - yy);
    if (degree < 3) return;
    basis[9] = T(-0.5900435899266435) * y * (3 * xx - yy);
    basis[10] = T(2.890611442640554) * x * y * z;
    basis[11] = T(-0.4570457994644658) * y * (4 * zz - xx - yy);
    basis[12] = T(0.3731763325901154) * z * (2 * zz - 3 * xx - 3 * yy);
    basis[13] = T(-0.4570457994644658) * x * (4 * zz - xx - yy);
    basis[14] = T(1.445305721320277) * z * (xx - yy);
    basis[15] = T(-0.5900435899266435) * x * (xx - 3 * yy);
}

// Computes the gradient of the unit direction from the gradients `g` of the bases.
template <class V>
V3DG_HD V3DG_INLINE void sh_bases_vjp(int degree, V x, V y, V z, const V g[kMaxShBases],
                                      V g_dir[3]) {
    using T = Lane<V>;
    V gx = V{}, gy = V{}, gz = V{};
    if (degree >= 1) {
        const T c1 = T(0.4886025119029199);
        gy -= c1 * g[1];
        gz += c1 * g[2];
        gx -= c1 * g[3];
    }
    if (degree >= 2) {
        const T a = T(1.0925484305920792), b = T(0.31539156525252005), c = T(0.5462742152960396);
        gx += a * y * g[4] - 2 * b * x * g[6] - a * z * g[7] + 2 * c * x * g[8];
        gy += a * x * g[4] - a * z * g[5] - 2 * b * y * g[6] - 2 * c * y * g[8];
        gz += -a * y * g[5] + 4 * b * z * g[6] - a * x * g[7];
    }
    if (degree >= 3) {
        const V xx = x * x, yy = y * y, zz = z * z;
        const T a = T(0.5900435899266435), b = T(2.890611442640554), c = T(0.4570457994644658);
        const T d = T(0.3731763325901154), e = T(1.445305721320277);
        gx += -6 * a * x * y * g[9] + b * y * z * g[10] + 2 * c * x * y * g[11] -
              6 * d * x * z * g[12] - c * (4 * zz - 3 * xx - yy) * g[13] + 2 * e * x * z * g[14] -
              3 * a * (xx - yy) * g[15];
        gy += -3 * a * (xx - yy) * g[9] + b * x * z * g[10] - c * (4 * zz - xx - 3 * yy) * g[11] -
              6 * d * y * z * g[12] + 2 * c * x * y * g[13] - 2 * e * y * z * g[14] +
              6 * a * x * y * g[15];
        gz += b * x * y * g[10] - 8 * c * y * z * g[11] + d * (6 * zz - 3 * xx - 3 * yy) * g[12] -
              8 * c * x * z * g[13] + e * (xx - yy) * g[14];
    }
    g_dir[0] = gx;
    g_dir[1] = gy;
    g_dir[2] = gz;
}

// Computes the colour of a gaussian. `direction` points from the eye to the gaussian,
// in model space, and may have any length. A channel that is not finite becomes 0.
// Otherwise, pixels in which the gaussian has weight 0 would become NaN.
//
// sh(k) returns the k-th coefficient, of one gaussian or of one per lane, basis by
// basis with three channels each. Each coefficient is requested once, in this order.
template <class V, class Coefficient>
V3DG_HD V3DG_INLINE void color_of_coefficients(int degree, const V direction[3],
                                               const Coefficient& sh, V color[3]) {
    using L = Lane<V>;
    const V most = all_lanes<V>(kInfinite<L>);
    if (degree == kPlainColor) {
        for (int c = 0; c < 3; ++c) {
            const V x = sh(c);
            color[c] = ((x < most) & (x > -most)) ? x : V{};
        }
        return;
    }
    V basis[kMaxShBases];
    V dir[3] = {direction[0], direction[1], direction[2]};
    if (degree > 0) {
        const V n2 = dot3(dir, dir);
        const V inv = n2 > V{} ? 1 / sqrt_of(n2) : V{};
        for (int i = 0; i < 3; ++i) dir[i] *= inv;
    }
    sh_bases(degree, dir[0], dir[1], dir[2], basis);
    const V half = all_lanes<V>(L(0.5));
    V sum[3] = {half, half, half};
    for (int b = 0; b < num_sh_bases(degree); ++b)
        for (int c = 0; c < 3; ++c) sum[c] += basis[b] * sh(3 * b + c);
    for (int c = 0; c < 3; ++c) {
        sum[c] = max_of(sum[c], V{});
        color[c] = sum[c] < most ? sum[c] : V{};
    }
}

// Like color_of_coefficients(), for coefficients in memory.
template <class V>
V3DG_HD V3DG_INLINE void color_of_sh(int degree, const V direction[3], const V* sh, V color[3]) {
    color_of_coefficients(degree, direction, [&](int k) { return sh[k]; }, color);
}

// Propagates the gradient of the colour. Adds to `d_direction`, and writes `d_sh`,
// which may be the same memory as `sh`.
template <class V>
V3DG_HD V3DG_INLINE void color_of_sh_vjp(int degree, const V direction[3], const V* sh,
                                         const V color[3], const V d_color[3], V d_direction[3],
                                         V* d_sh) {
    if (degree == kPlainColor) {
        for (int c = 0; c < 3; ++c) d_sh[c] = d_color[c];
        return;
    }
    V basis[kMaxShBases], d_basis[kMaxShBases];
    V dir[3] = {direction[0], direction[1], direction[2]};
    V inv = V{};
    if (degree > 0) {
        const V n2 = dot3(dir, dir);
        inv = n2 > V{} ? 1 / sqrt_of(n2) : V{};
        for (int i = 0; i < 3; ++i) dir[i] *= inv;
    }
    sh_bases(degree, dir[0], dir[1], dir[2], basis);
    for (int b = 0; b < num_sh_bases(degree); ++b) d_basis[b] = V{};
    for (int c = 0; c < 3; ++c) {
        const auto moves = color[c] > V{};
        const V d = moves ? d_color[c] : V{};
        for (int b = 0; b < num_sh_bases(degree); ++b) {
            d_basis[b] += moves ? sh[3 * b + c] * d : V{};
            d_sh[3 * b + c] = basis[b] * d;
        }
    }
    if (degree == 0) return;
    V d_dir[3];
    sh_bases_vjp(degree, dir[0], dir[1], dir[2], d_basis, d_dir);
    const V along = dot3(dir, d_dir);
    for (int i = 0; i < 3; ++i) d_direction[i] += inv * (d_dir[i] - along * dir[i]);
}

}  // namespace v3dg
