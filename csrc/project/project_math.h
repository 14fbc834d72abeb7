#pragma once

// One gaussian, seen by one camera: its ellipse on the image, and the gradients of it.
//
// EWA projection (Zwicker et al. 2001) as 3D Gaussian Splatting uses it (Kerbl et al. 2023). The 2D
// covariance is A Aᵀ + filter I with A = J W R S (2x3), so its determinant is |a1 x a2|² plus terms
// that are positive: nothing cancels, however thin the gaussian is.

#include "frame/draw_list.h"
#include "math/camera.h"
#include "math/ellipse.h"
#include "math/gaussian.h"
#include "math/quat.h"
#include "math/vec.h"

namespace v3dg {

// What the gradients need again.
template <class V>
struct Projection {
    V p[3];          // view space
    V linear_rs[9];  // view-space linear part times the gaussian's rotation and scales
    V a1[3], a2[3];
    V slope_x, slope_y;  // x / z and y / z, clamped
    V c11, c12, c22, det0, det;
};

// Sets the slopes of s.p.
template <class V, class T>
V3DG_HD V3DG_INLINE void set_slopes(const SlopeLimits<T>& limits, V inv_z, Projection<V>& s) {
    s.slope_x = cut_to(limits.low_x, limits.high_x, s.p[0] * inv_z);
    s.slope_y = cut_to(limits.low_y, limits.high_y, s.p[1] * inv_z);
}

// Of a filter that is limited a gaussian gets so many times its own variance at most, the square
// root of its determinant. What is left of the opacity of a round one is then never less than a
// fifth: without, nothing would be left of what many tiny gaussians cover, each below the least
// alpha that is drawn.
constexpr float kMostFilterOfVariance = 4;

// The ellipse whose covariance is A Aᵀ + filter I, with the rows a1 and a2 of A and p in `s`; all
// but its opacity.
template <class V, class T>
V3DG_HD V3DG_INLINE Ellipse<V> ellipse_of_axes(const Pinhole<T>& cam, T most_filter_px2,
                                               bool is_limited, V inv_z, Projection<V>& s) {
    V normal[3];
    cross3(s.a1, s.a2, normal);
    const V n11 = dot3(s.a1, s.a1), n22 = dot3(s.a2, s.a2);
    s.det0 = dot3(normal, normal);
    V filter_px2 = all_lanes<V>(most_filter_px2);
    if (is_limited) filter_px2 = min_of(filter_px2, T(kMostFilterOfVariance) * sqrt_of(s.det0));
    s.c11 = n11 + filter_px2;
    s.c22 = n22 + filter_px2;
    s.c12 = dot3(s.a1, s.a2);
    s.det = s.det0 + filter_px2 * (n11 + n22) + filter_px2 * filter_px2;

    Ellipse<V> e;
    e.u = cam.fx * s.p[0] * inv_z + cam.cx;
    e.v = cam.fy * s.p[1] * inv_z + cam.cy;
    e.l11 = T(kFalloffScale) * sqrt_of(quotient_of(s.c22, s.det));
    e.l12 = -quotient_of(s.c12, s.c22) * e.l11;
    e.l22 = quotient_of(all_lanes<V>(T(kFalloffScale)), sqrt_of(s.c22));
    e.depth = s.p[2];
    return e;
}

// Ellipse of a gaussian; s.p is set, with p[2] > 0. `filter_px2` is added to both variances; with
// `antialiased` (0 or 1) the opacity is multiplied by sqrt(det before / det after), which keeps
// what the gaussian covers.
template <class V, class T>
V3DG_HD V3DG_INLINE Ellipse<V> project_gaussian(const Gaussian3d<V>& g, const ModelView<T>& mv,
                                                const Pinhole<T>& cam, T filter_px2,
                                                bool antialiased, Projection<V>& s,
                                                bool is_limited = false) {
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
    Ellipse<V> e = ellipse_of_axes(cam, filter_px2, is_limited, inv_z, s);
    const V opacity = antialiased ? g.opacity * sqrt_of(s.det0 / s.det) : g.opacity;
    e.log2_opacity = log2_of(opacity);
    return e;
}

// Multiplies the opacity by the weight of a level that is on its way in or out.
template <class V>
V3DG_HD V3DG_INLINE void fade(Lane<V> weight, Ellipse<V>& e) {
    e.log2_opacity += log2_of(weight);
}

// How far from its centre, px, alpha is 1/255 or more: where |L d|² = log2 of alpha at the centre
// over 1/255. Returns whether it is anywhere, at a depth that is finite; the extent means nothing
// where it is not.
template <class V>
V3DG_HD V3DG_INLINE auto extent_of(V opacity, const Ellipse<V>& e, const Projection<V>& s,
                                   V& half_x, V& half_y) {
    using T = Lane<V>;
    const V huge = all_lanes<V>(kLargest<T>);
    const V reach = e.log2_opacity - all_lanes<V>(T(kLog2MinAlpha));
    half_x = sqrt_of(reach * s.c11) * T(1 / kFalloffScale);
    half_y = sqrt_of(reach * s.c22) * T(1 / kFalloffScale);
    return (opacity >= all_lanes<V>(T(kMinAlpha))) & (opacity < huge) & (reach >= V{}) &
           (s.det > V{}) & (s.det < huge) & (half_x < huge) & (half_y < huge) & (e.depth < huge);
}

// As project_gaussian(); s.p is set, s.linear_rs is left alone.
V3DG_HD V3DG_INLINE Ellipse<float> project_packed(
    const PackedGaussian& g, const ModelView<float>& mv, const Pinhole<float>& cam,
    const SlopeLimits<float>& limits, const Appearance<float>& look, Projection<float>& s) {
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
    Ellipse<float> e = ellipse_of_axes(cam, look.filter_px2, look.is_limited, inv_z, s);
    e.log2_opacity =
        look.antialiased ? g.log2_opacity + 0.5f * log2_of(s.det0 / s.det) : g.log2_opacity;
    return e;
}

// Whether sphere_of_image() holds: where the Jacobian is clamped, it is clamped towards the
// camera's axis.
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

// Whether there is no pixel centre within `half` of `center` on one axis, with the margin of
// pixel_span().
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

// The pixels from ceil(low) to floor(high) have their centres within `half` of `center`, or within
// a margin of that, so that the blend step alone decides. `low` is from 0 to size and `high` from
// -1 to size - 1, whatever the arguments, not a number included: none of them overflows an integer.
template <class V>
V3DG_HD V3DG_INLINE void pixel_span(V center, V half, Lane<V> size, V& low, V& high) {
    using T = Lane<V>;
    const V margin = half * T(1e-5) + T(2e-3);
    // The second argument is what is left of one that is not a number.
    low = min_of(max_of(center - half - margin - T(0.5), V{}), all_lanes<V>(size));
    high = max_of(min_of(center + half + margin - T(0.5), all_lanes<V>(size - 1)),
                  all_lanes<V>(T(-1)));
}

// The pixels of an image of the camera's size whose centres lie in the box of an ellipse of this
// extent.
template <class V>
V3DG_HD V3DG_INLINE auto pixel_box(const Ellipse<V>& e, V half_x, V half_y,
                                   const Pinhole<Lane<V>>& camera) {
    V low_x, high_x, low_y, high_y;
    pixel_span(e.u, half_x, camera.width, low_x, high_x);
    pixel_span(e.v, half_y, camera.height, low_y, high_y);
    using I = decltype(ceil_to_int(low_x));
    return PixelBox<I>{ceil_to_int(low_x), floor_to_int(high_x), ceil_to_int(low_y),
                       floor_to_int(high_y)};
}

// Gradients of the gaussian's mean, quaternion, scales and opacity from those of its ellipse.
template <class V, class T>
V3DG_HD V3DG_INLINE Gaussian3d<V> project_gaussian_vjp(const Gaussian3d<V>& g,
                                                       const ModelView<T>& mv,
                                                       const Pinhole<T>& cam, T filter_px2,
                                                       bool antialiased, const Projection<V>& s,
                                                       const Ellipse<V>& e, const Ellipse<V>& d) {
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
    if (antialiased) {
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
        d_a2[k] =
            2 * (d_det0 * into_a2[k] + (filter_px2 * d_det + d_c22) * s.a2[k]) + d_c12 * s.a1[k];
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
    d_p[2] = d.depth - inv_z * (dot3(s.a1, d_a1) + dot3(s.a2, d_a2) + true_x * d_slope_x +
                                true_y * d_slope_y);

    for (int i = 0; i < 3; ++i)
        out.mean[i] = mv.linear[i] * d_p[0] + mv.linear[3 + i] * d_p[1] + mv.linear[6 + i] * d_p[2];
    V r[9], d_r[9];
    rotation_of_quat(g.quat, r);
    for (int k = 0; k < 3; ++k) {
        out.scale[k] = V{};
        for (int i = 0; i < 3; ++i) {
            const V d_rs = mv.linear[i] * d_m[k] + mv.linear[3 + i] * d_m[3 + k] +
                           mv.linear[6 + i] * d_m[6 + k];
            out.scale[k] += r[3 * i + k] * d_rs;
            d_r[3 * i + k] = g.scale[k] * d_rs;
        }
    }
    rotation_of_quat_vjp(g.quat, d_r, out.quat);
    return out;
}

}  // namespace v3dg
