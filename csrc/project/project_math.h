#pragma once

// One gaussian, seen by one camera: its ellipse on the image, and the way back.
//
// EWA projection (Zwicker et al. 2001) as 3D Gaussian Splatting uses it (Kerbl et al. 2023). The 2D
// covariance is A Aᵀ + filter I with A = J W R S (2x3), so its determinant is |a1 x a2|² plus terms that are
// positive: nothing cancels, however thin the gaussian is.

#include "math/lanes.h"
#include "math/quat.h"
#include "math/sh.h"

namespace v3dg {

constexpr double kMinAlpha = 1.0 / 255;     // contributions below it are skipped
constexpr double kMaxAlpha = 0.999;         // alpha is cut here
constexpr double kMinTransmittance = 1e-4;  // a pixel stops before it would fall to this
constexpr double kLog2MinAlpha = -7.994353436858858;
constexpr double kFovMargin = 0.3;     // of the half field of view: where the Jacobian is clamped
constexpr double kReachSigmas = 3.33;  // where opacity 1 has fallen below 1/255
constexpr double kLn2 = 0.6931471805599453;
constexpr double kFalloffScale = 0.8493218002880191;  // sqrt(log2(e) / 2): exp(-d²/2) = 2^-(scale d)²

// Image side of a pinhole camera. Pixels; pixel (i, j) has its centre at (i + ½, j + ½).
template <class T>
struct Pinhole {
    T fx, fy, cx, cy;
    T width, height;
    T near_depth;
};

// Model space to view space: view = linear * model + translation, linear = uniform scale * rotation.
template <class T>
struct ModelView {
    T linear[9];  // row major
    T translation[3];
    T eye[3];  // the camera's position in model space
};

template <class V>
struct Gaussian3d {
    V mean[3];
    V quat[4];   // w, x, y, z; any length but zero
    V scale[3];  // standard deviations
    V opacity;
};

// Alpha at offset d from the centre is 2^(log2_opacity - |L d|²) with L = [[l11, l12], [0, l22]].
template <class V>
struct Ellipse {
    V u, v;  // px
    V l11, l12, l22;
    V log2_opacity;
    V depth;
};

// What the way back needs again.
template <class V>
struct Projection {
    V p[3];          // view space
    V linear_rs[9];  // view-space linear part times the gaussian's rotation and scales
    V a1[3], a2[3];
    V slope_x, slope_y;  // x / z and y / z, clamped
    V c11, c12, c22, det0, det;
};

template <class V>
V3DG_HD V3DG_INLINE V dot3(const V a[3], const V b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
template <class V>
V3DG_HD V3DG_INLINE void cross3(const V a[3], const V b[3], V c[3]) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
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

// Sets the slopes of s.p.
template <class V, class T>
V3DG_HD V3DG_INLINE void set_slopes(const SlopeLimits<T>& limits, V inv_z, Projection<V>& s) {
    s.slope_x = min_of(all_lanes<V>(limits.high_x), max_of(all_lanes<V>(limits.low_x), s.p[0] * inv_z));
    s.slope_y = min_of(all_lanes<V>(limits.high_y), max_of(all_lanes<V>(limits.low_y), s.p[1] * inv_z));
}

// The ellipse whose covariance is A Aᵀ + filter I, with the rows a1 and a2 of A and p in `s`; all but its
// opacity.
template <class V, class T>
V3DG_HD V3DG_INLINE Ellipse<V> ellipse_of_axes(const Pinhole<T>& cam, T filter_px2, V inv_z,
                                               Projection<V>& s) {
    V normal[3];
    cross3(s.a1, s.a2, normal);
    const V n11 = dot3(s.a1, s.a1), n22 = dot3(s.a2, s.a2);
    s.c11 = n11 + filter_px2;
    s.c22 = n22 + filter_px2;
    s.c12 = dot3(s.a1, s.a2);
    s.det0 = dot3(normal, normal);
    s.det = s.det0 + filter_px2 * (n11 + n22) + filter_px2 * filter_px2;

    Ellipse<V> e;
    e.u = cam.fx * s.p[0] * inv_z + cam.cx;
    e.v = cam.fy * s.p[1] * inv_z + cam.cy;
    e.l11 = T(kFalloffScale) * sqrt_of(s.c22 / s.det);
    e.l12 = -(s.c12 / s.c22) * e.l11;
    e.l22 = T(kFalloffScale) / sqrt_of(s.c22);
    e.depth = s.p[2];
    return e;
}

// Ellipse of a gaussian with p[2] > 0. `filter_px2` is added to both variances; with `compensate` (0 or 1)
// the opacity is multiplied by sqrt(det before / det after), which keeps what the gaussian covers.
template <class V, class T>
V3DG_HD V3DG_INLINE Ellipse<V> project_gaussian(const Gaussian3d<V>& g, const ModelView<T>& mv,
                                                const Pinhole<T>& cam, T filter_px2, bool compensate,
                                                Projection<V>& s) {
    for (int i = 0; i < 3; ++i)
        s.p[i] = mv.linear[3 * i] * g.mean[0] + mv.linear[3 * i + 1] * g.mean[1] +
                 mv.linear[3 * i + 2] * g.mean[2] + mv.translation[i];
    V r[9];
    rotation_of_quat(g.quat, r);
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            s.linear_rs[3 * i + k] = (mv.linear[3 * i] * r[k] + mv.linear[3 * i + 1] * r[3 + k] +
                                      mv.linear[3 * i + 2] * r[6 + k]) *
                                     g.scale[k];
    const V inv_z = 1 / s.p[2];
    set_slopes(slope_limits(cam), inv_z, s);
    for (int k = 0; k < 3; ++k) {
        s.a1[k] = cam.fx * inv_z * (s.linear_rs[k] - s.slope_x * s.linear_rs[6 + k]);
        s.a2[k] = cam.fy * inv_z * (s.linear_rs[3 + k] - s.slope_y * s.linear_rs[6 + k]);
    }
    Ellipse<V> e = ellipse_of_axes(cam, filter_px2, inv_z, s);
    const V opacity = compensate ? g.opacity * sqrt_of(s.det0 / s.det) : g.opacity;
    e.log2_opacity = log2_of(opacity);
    return e;
}

// How far from its centre, px, alpha is 1/255 or more: where |L d|² = log2 of alpha at the centre over 1/255.
// Returns whether it is anywhere; the extent means nothing where it is not.
template <class V>
V3DG_HD V3DG_INLINE auto extent_of(V opacity, const Ellipse<V>& e, const Projection<V>& s, V& half_x,
                                   V& half_y) {
    using T = Lane<V>;
    const V huge = all_lanes<V>(kLargest<T>);
    const V reach = e.log2_opacity - all_lanes<V>(T(kLog2MinAlpha));
    half_x = sqrt_of(reach * s.c11) * T(1 / kFalloffScale);
    half_y = sqrt_of(reach * s.c22) * T(1 / kFalloffScale);
    return (opacity >= all_lanes<V>(T(kMinAlpha))) & (reach >= V{}) & (s.det > V{}) & (s.det < huge) &
           (half_x < huge) & (half_y < huge);
}

// How far from its mean a gaussian reaches at most, in its model's units: no less than extent_of() leads to.
// Negative where it is too faint to be drawn, not a number where it may have no area, or is none.
V3DG_HD inline float reach_of(const Gaussian3d<float>& g) {
    if (g.opacity < float(kMinAlpha)) return -1.0f;
    const float least = min_of(g.scale[0], min_of(g.scale[1], g.scale[2]));
    const float most = max_of(g.scale[0], max_of(g.scale[1], g.scale[2]));
    const float sigmas = sqrt_of(log2_of(g.opacity) - float(kLog2MinAlpha)) * float(1.001 / kFalloffScale);
    return least > 0 && g.opacity <= 1 ? most * sigmas : NAN;
}

// A gaussian in the form that is quickest to project, for what is projected more than once. Its covariance is
// F Fᵀ with F = [f[0] f[3] 0; f[1] f[4] f[6]; f[2] f[5] f[7]], columns from the longest on.
struct PackedGaussian {
    float mean[3];
    float reach;
    float f[8];
    float log2_opacity;
};

V3DG_HD inline PackedGaussian pack_gaussian(const Gaussian3d<float>& g) {
    PackedGaussian out{};
    for (int k = 0; k < 3; ++k) out.mean[k] = g.mean[k];
    out.log2_opacity = log2_of(g.opacity);
    out.reach = reach_of(g);
    double quat[4], r[9];
    for (int k = 0; k < 4; ++k) quat[k] = g.quat[k];
    rotation_of_quat(quat, r);
    int order[3] = {0, 1, 2};
    for (int pass = 0; pass < 3; ++pass) {
        const int k = pass % 2;
        if (g.scale[order[k]] >= g.scale[order[k + 1]]) continue;
        const int other = order[k];
        order[k] = order[k + 1];
        order[k + 1] = other;
    }
    double column[3][3];
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < 3; ++i) column[k][i] = r[3 * i + order[k]] * double(g.scale[order[k]]);
    // Turning two columns into each other leaves F Fᵀ; a number becomes 0. The shorter two, whose lengths
    // then differ least from before.
    const double x = column[1][0], y = column[2][0], length = sqrt_of(x * x + y * y);
    const double cosine = length > 0 ? x / length : 1, sine = length > 0 ? y / length : 0;
    for (int i = 0; i < 3; ++i) {
        const double a = column[1][i], b = column[2][i];
        column[1][i] = cosine * a + sine * b;
        column[2][i] = cosine * b - sine * a;
    }
    for (int i = 0; i < 3; ++i) {
        out.f[i] = static_cast<float>(column[0][i]);
        out.f[3 + i] = static_cast<float>(column[1][i]);
    }
    out.f[6] = static_cast<float>(column[2][1]);
    out.f[7] = static_cast<float>(column[2][2]);
    return out;
}

// As project_gaussian(); s.p is set, s.linear_rs is left alone.
V3DG_HD V3DG_INLINE Ellipse<float> project_packed(const PackedGaussian& g, const ModelView<float>& mv,
                                                  const Pinhole<float>& cam, const SlopeLimits<float>& limits,
                                                  float filter_px2, bool compensate, Projection<float>& s) {
    const float inv_z = 1 / s.p[2];
    set_slopes(limits, inv_z, s);
    float row1[3], row2[3];  // of the Jacobian times the view
    for (int k = 0; k < 3; ++k) {
        row1[k] = cam.fx * inv_z * (mv.linear[k] - s.slope_x * mv.linear[6 + k]);
        row2[k] = cam.fy * inv_z * (mv.linear[3 + k] - s.slope_y * mv.linear[6 + k]);
    }
    for (int k = 0; k < 2; ++k) {
        s.a1[k] = dot3(row1, g.f + 3 * k);
        s.a2[k] = dot3(row2, g.f + 3 * k);
    }
    s.a1[2] = row1[1] * g.f[6] + row1[2] * g.f[7];
    s.a2[2] = row2[1] * g.f[6] + row2[2] * g.f[7];
    Ellipse<float> e = ellipse_of_axes(cam, filter_px2, inv_z, s);
    e.log2_opacity = compensate ? g.log2_opacity + 0.5f * log2_of(s.det0 / s.det) : g.log2_opacity;
    return e;
}

// Whether sphere_of_image() holds: where the Jacobian is clamped, it is clamped towards the camera's axis.
template <class T>
V3DG_HD V3DG_INLINE bool sees_its_axis(const SlopeLimits<T>& limits) {
    return limits.low_x < 0 && limits.high_x > 0 && limits.low_y < 0 && limits.high_y > 0;
}

// No less than either half of extent_of(), of what reaches `reach_px` from its mean at depth 1.
template <class T>
V3DG_HD V3DG_INLINE T sphere_of_image(T reach_px, T inv_z, T slope_x, T slope_y, T filter_px2) {
    const T along = reach_px * inv_z;
    return sqrt_of(along * along * (1 + slope_x * slope_x + slope_y * slope_y) +
                   T(kReachSigmas * kReachSigmas) * filter_px2);
}

// Whether there is no pixel centre within `half` of `center` on one axis, with the hair of pixel_span().
template <class T>
V3DG_HD V3DG_INLINE bool misses_centers(T center, T half) {
    const T from_center = center - T(0.5);
    return abs_of(from_center - round_of(from_center)) > half * T(1 + 1e-5) + T(2e-3);
}

// Whether what reaches `half` from `center` meets (0, size).
template <class V>
V3DG_HD V3DG_INLINE auto meets_image(V center, V half, Lane<V> size) {
    return (center + half > V{}) & (center - half < all_lanes<V>(size));
}

// The pixels from ceil(low) to floor(high) have their centres within `half` of `center`, or a hair farther,
// so that the blend step alone decides. From -1 or 0 to size - 1 or size.
template <class V>
V3DG_HD V3DG_INLINE void pixel_span(V center, V half, Lane<V> size, V& low, V& high) {
    using T = Lane<V>;
    const V hair = half * T(1e-5) + T(2e-3);
    low = max_of(all_lanes<V>(T(-1)), center - half - hair - T(0.5));
    high = min_of(all_lanes<V>(size), center + half + hair - T(0.5));
}

// Gradients of the gaussian's mean, quaternion, scales and opacity from those of its ellipse.
template <class V, class T>
V3DG_HD V3DG_INLINE Gaussian3d<V> project_gaussian_vjp(const Gaussian3d<V>& g, const ModelView<T>& mv,
                                                       const Pinhole<T>& cam, T filter_px2, bool compensate,
                                                       const Projection<V>& s, const Ellipse<V>& e,
                                                       const Ellipse<V>& d) {
    const V inv_z = 1 / s.p[2];
    // Ellipse -> covariance (c11 enters through det alone).
    const V d_l11 = d.l11 - d.l12 * (s.c12 / s.c22);
    const V half = 1 / (2 * s.c22);
    const V d_c22 = (d_l11 * e.l11 - d.l22 * e.l22) * half - d.l12 * e.l12 / s.c22;
    const V d_c12 = -d.l12 * e.l11 / s.c22;
    V d_det = -d_l11 * e.l11 / (2 * s.det);
    V d_det0 = V{};
    Gaussian3d<V> out;
    // log2_opacity = log2(opacity) + log2(det0 / det) / 2
    out.opacity = d.log2_opacity / (T(kLn2) * g.opacity);
    if (compensate) {
        d_det -= d.log2_opacity / (T(2 * kLn2) * s.det);
        d_det0 = d.log2_opacity / (T(2 * kLn2) * s.det0);
    }
    d_det0 += d_det;
    V normal[3], into_a1[3], into_a2[3];
    cross3(s.a1, s.a2, normal);
    cross3(s.a2, normal, into_a1);
    cross3(normal, s.a1, into_a2);
    V d_a1[3], d_a2[3];
    for (int k = 0; k < 3; ++k) {
        d_a1[k] = 2 * (d_det0 * into_a1[k] + filter_px2 * d_det * s.a1[k]) + d_c12 * s.a2[k];
        d_a2[k] = 2 * (d_det0 * into_a2[k] + (filter_px2 * d_det + d_c22) * s.a2[k]) + d_c12 * s.a1[k];
    }

    // a1 = fx / z (m1 - slope_x m3), a2 = fy / z (m2 - slope_y m3), where m is linear_rs.
    const V fx_z = cam.fx * inv_z, fy_z = cam.fy * inv_z;
    V d_m[9];
    for (int k = 0; k < 3; ++k) {
        d_m[k] = fx_z * d_a1[k];
        d_m[3 + k] = fy_z * d_a2[k];
        d_m[6 + k] = -s.slope_x * d_m[k] - s.slope_y * d_m[3 + k];
    }
    const V true_x = s.p[0] * inv_z, true_y = s.p[1] * inv_z;
    V d_slope_x = -(d_m[0] * s.linear_rs[6] + d_m[1] * s.linear_rs[7] + d_m[2] * s.linear_rs[8]);
    V d_slope_y = -(d_m[3] * s.linear_rs[6] + d_m[4] * s.linear_rs[7] + d_m[5] * s.linear_rs[8]);
    d_slope_x = (true_x == s.slope_x ? d_slope_x : V{}) + d.u * cam.fx;
    d_slope_y = (true_y == s.slope_y ? d_slope_y : V{}) + d.v * cam.fy;
    V d_p[3];
    d_p[0] = d_slope_x * inv_z;
    d_p[1] = d_slope_y * inv_z;
    d_p[2] =
        d.depth - inv_z * (dot3(s.a1, d_a1) + dot3(s.a2, d_a2) + true_x * d_slope_x + true_y * d_slope_y);

    for (int i = 0; i < 3; ++i)
        out.mean[i] = mv.linear[i] * d_p[0] + mv.linear[3 + i] * d_p[1] + mv.linear[6 + i] * d_p[2];
    V r[9], d_r[9];
    rotation_of_quat(g.quat, r);
    for (int k = 0; k < 3; ++k) {
        out.scale[k] = V{};
        for (int i = 0; i < 3; ++i) {
            const V d_rs =
                mv.linear[i] * d_m[k] + mv.linear[3 + i] * d_m[3 + k] + mv.linear[6 + i] * d_m[6 + k];
            out.scale[k] += r[3 * i + k] * d_rs;
            d_r[3 * i + k] = g.scale[k] * d_rs;
        }
    }
    rotation_of_quat_vjp(g.quat, d_r, out.quat);
    return out;
}

// Colour in the direction from the camera's position in model space; what is not finite is 0, so that it
// stays off pixels on which the gaussian has no weight. `sh` holds the coefficients of one gaussian (or of
// one a lane), base by base, three channels each.
template <class V, class T>
V3DG_HD V3DG_INLINE void color_of_sh(int degree, const V mean[3], const ModelView<T>& mv, const V* sh,
                                     V color[3]) {
    using L = Lane<V>;
    V basis[kMaxShBases];
    V dir[3] = {mean[0] - mv.eye[0], mean[1] - mv.eye[1], mean[2] - mv.eye[2]};
    if (degree > 0) {
        const V n2 = dot3(dir, dir);
        const V inv = n2 > V{} ? 1 / sqrt_of(n2) : V{};
        for (int i = 0; i < 3; ++i) dir[i] *= inv;
    }
    sh_bases(degree, dir[0], dir[1], dir[2], basis);
    for (int c = 0; c < 3; ++c) {
        V sum = all_lanes<V>(T(0.5));
        for (int b = 0; b < num_sh_bases(degree); ++b) sum += basis[b] * sh[3 * b + c];
        sum = max_of(sum, V{});
        color[c] = sum < all_lanes<V>(kInfinite<L>) ? sum : V{};
    }
}

// Adds to `d_mean` and sets `d_sh` from the gradient of the colour. `d_sh` may be `sh` itself.
template <class V, class T>
V3DG_HD V3DG_INLINE void color_of_sh_vjp(int degree, const V mean[3], const ModelView<T>& mv, const V* sh,
                                         const V color[3], const V d_color[3], V d_mean[3], V* d_sh) {
    V basis[kMaxShBases], d_basis[kMaxShBases];
    V dir[3] = {mean[0] - mv.eye[0], mean[1] - mv.eye[1], mean[2] - mv.eye[2]};
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
    for (int i = 0; i < 3; ++i) d_mean[i] += inv * (d_dir[i] - along * dir[i]);
}

}  // namespace v3dg
