#pragma once

// Projects one gaussian with one camera: its ellipse on the image, the pixels that it
// may reach, and the gradients.
//
// This is EWA projection (Zwicker et al. 2001) as used by 3D Gaussian Splatting (Kerbl
// et al. 2023), for any camera model (camera/camera.h). The 2D covariance is A Aᵀ +
// filter I, with the 2x3 matrix A = J W R S, where J is the Jacobian of the camera
// model. Its determinant is |a1 x a2|² plus positive terms, so there is no
// cancellation, however thin the gaussian is.

#include "camera/camera.h"
#include "frame/draw_list.h"
#include "math/ellipse.h"
#include "math/gaussian.h"
#include "math/quat.h"
#include "math/vec.h"

namespace v3dg {

// Intermediate results of the projection, which the backward pass reuses.
template <class V, ProjectingModel C>
struct Projection {
    V p[3];          // mean, in view space
    V linear_rs[9];  // W R S: the gaussian's axes in view space
    V a1[3], a2[3];
    typename C::template Point<V> at;  // determines the Jacobian at p
    V c11, c12, c22, det0, det;
};

// The upper limit of a limited filter, as a multiple of the square root of the
// determinant of the gaussian's own 2D covariance. With this limit, a round gaussian
// keeps at least a fifth of its opacity. Without it, an area that is covered by many
// tiny gaussians could vanish, because all of their alphas could fall below 1/255.
constexpr float kMostFilterOfVariance = 4;

// Returns the ellipse with covariance A Aᵀ + filter I, but does not set its opacity.
// `s` must have p, the Jacobian, and the rows a1 and a2 of A.
template <class V, ProjectingModel C>
V3DG_HD V3DG_INLINE Ellipse<V> ellipse_of_axes(const C& cam, Lane<V> most_filter_px2,
                                               bool is_limited, Projection<V, C>& s) {
    using T = Lane<V>;
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
    cam.to_pixel(s.at, s.p, e.u, e.v);
    e.l11 = T(kFalloffScale) * sqrt_of(quotient_of(s.c22, s.det));
    e.l12 = -quotient_of(s.c12, s.c22) * e.l11;
    e.l22 = quotient_of(all_lanes<V>(T(kFalloffScale)), sqrt_of(s.c22));
    e.depth = cam.depth_of(s.p);
    return e;
}

// Returns the ellipse of a gaussian. Precondition: s.p is set, and its depth is
// positive. `filter_px2` is added to both variances. If `antialiased` is true, the
// opacity is multiplied by sqrt(determinant before / after adding the filter), which
// preserves the gaussian's integral over the image.
template <class V, class T, ProjectingModel C>
V3DG_HD V3DG_INLINE Ellipse<V> project_gaussian(const Gaussian3d<V>& g, const ModelView<T>& mv,
                                                const C& cam, T filter_px2, bool antialiased,
                                                Projection<V, C>& s, bool is_limited = false) {
    V r[9];
    rotation_of_quat(g.quat, r);
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            s.linear_rs[3 * i + k] = (mv.linear[3 * i] * r[k] + mv.linear[3 * i + 1] * r[3 + k] +
                                      mv.linear[3 * i + 2] * r[6 + k]) *
                                     g.scale[k];
    s.at = cam.linearized(cam.limits(), s.p);
    for (int k = 0; k < 3; ++k)
        cam.times_jacobian(s.at, s.linear_rs[k], s.linear_rs[3 + k], s.linear_rs[6 + k], s.a1[k],
                           s.a2[k]);
    Ellipse<V> e = ellipse_of_axes(cam, filter_px2, is_limited, s);
    const V opacity = antialiased ? g.opacity * sqrt_of(s.det0 / s.det) : g.opacity;
    e.log2_opacity = log2_of(opacity);
    return e;
}

// Multiplies the opacity by `weight`, which is below 1 for a cluster that fades in or
// out.
template <class V>
V3DG_HD V3DG_INLINE void fade(Lane<V> weight, Ellipse<V>& e) {
    e.log2_opacity += log2_of(weight);
}

// Sets half_x and half_y: the half size, px, of the box in which alpha can be at least
// 1/255. This is where |L d|² <= log2(255 alpha), with alpha at the centre. Returns
// false, and leaves the box undefined, if the depth is not finite or alpha is below
// 1/255 everywhere.
template <class V, ProjectingModel C>
V3DG_HD V3DG_INLINE auto extent_of(V opacity, const Ellipse<V>& e, const Projection<V, C>& s,
                                   V& half_x, V& half_y) {
    using T = Lane<V>;
    const V huge = all_lanes<V>(kLargest<T>);
    const V reach = e.log2_opacity - all_lanes<V>(T(kLog2MinAlpha));
    half_x = sqrt_of(reach * s.c11) * T(1 / kFalloffScale);
    half_y = sqrt_of(reach * s.c22) * T(1 / kFalloffScale);
    return (opacity >= all_lanes<V>(T(kMinAlpha))) & (opacity < huge) & (reach >= V{}) &
           (s.det > V{}) & (s.det < huge) & (half_x < huge) & (half_y < huge) & (e.depth < huge);
}

// Like project_gaussian(), but for packed gaussians. Precondition: s.p is set.
// s.linear_rs is not set.
template <ProjectingModel C>
V3DG_HD V3DG_INLINE Ellipse<float> project_packed(const PackedGaussian& g,
                                                  const ModelView<float>& mv, const C& cam,
                                                  const typename C::Limits& limits,
                                                  const Appearance<float>& look,
                                                  Projection<float, C>& s) {
    s.at = cam.linearized(limits, s.p);
    float row1[3], row2[3];  // J W, the Jacobian times the view rotation
    for (int k = 0; k < 3; ++k)
        cam.times_jacobian(s.at, mv.linear[k], mv.linear[3 + k], mv.linear[6 + k], row1[k],
                           row2[k]);
    for (int k = 0; k < 2; ++k) {
        s.a1[k] = dot3(row1, g.f + 3 * k);
        s.a2[k] = dot3(row2, g.f + 3 * k);
    }
    s.a1[2] = row1[1] * g.f[6] + row1[2] * g.f[7];
    s.a2[2] = row2[1] * g.f[6] + row2[2] * g.f[7];
    Ellipse<float> e = ellipse_of_axes(cam, look.filter_px2, look.is_limited, s);
    e.log2_opacity =
        look.antialiased ? g.log2_opacity + 0.5f * log2_of(s.det0 / s.det) : g.log2_opacity;
    return e;
}

// Returns whether no pixel centre is within `half` of `center` along one axis. The
// margin is the same as in pixel_span().
template <class T>
V3DG_HD V3DG_INLINE bool misses_centers(T center, T half) {
    const T from_center = center - T(0.5);
    return abs_of(from_center - round_of(from_center)) > half * T(1 + 1e-5) + T(2e-3);
}

// Returns whether the interval [center - half, center + half] intersects (0, size).
template <class V>
V3DG_HD V3DG_INLINE auto meets_image(V center, V half, Lane<V> size) {
    return (center + half > V{}) & (center - half < all_lanes<V>(size));
}

// Computes the range of pixels, along one axis, whose centres are within `half` of
// `center`: from ceil(low) to floor(high). A margin makes the range slightly too large,
// so that only the blend step decides about a pixel. For any input, including NaN,
// `low` is in [0, size] and `high` in [-1, size - 1], so they can safely be converted
// to integers.
template <class V>
V3DG_HD V3DG_INLINE void pixel_span(V center, V half, Lane<V> size, V& low, V& high) {
    using T = Lane<V>;
    const V margin = half * T(1e-5) + T(2e-3);
    // min_of(x, y) and max_of(x, y) return y if x is NaN.
    low = min_of(max_of(center - half - margin - T(0.5), V{}), all_lanes<V>(size));
    high = max_of(min_of(center + half + margin - T(0.5), all_lanes<V>(size - 1)),
                  all_lanes<V>(T(-1)));
}

// Returns the pixels of the image whose centres are in an ellipse's bounding box, which
// is given by its half sizes.
template <class V, ProjectingModel C>
V3DG_HD V3DG_INLINE auto pixel_box(const Ellipse<V>& e, V half_x, V half_y, const C& camera) {
    V low_x, high_x, low_y, high_y;
    pixel_span(e.u, half_x, camera.width, low_x, high_x);
    pixel_span(e.v, half_y, camera.height, low_y, high_y);
    using I = decltype(ceil_to_int(low_x));
    return PixelBox<I>{ceil_to_int(low_x), floor_to_int(high_x), ceil_to_int(low_y),
                       floor_to_int(high_y)};
}

// Computes the gradients of the gaussian's mean, quaternion, scales and opacity from
// `d`, the gradients of its ellipse.
template <class V, class T, ProjectingModel C>
V3DG_HD V3DG_INLINE Gaussian3d<V> project_gaussian_vjp(const Gaussian3d<V>& g,
                                                       const ModelView<T>& mv, const C& cam,
                                                       T filter_px2, bool antialiased,
                                                       const Projection<V, C>& s,
                                                       const Ellipse<V>& e, const Ellipse<V>& d) {
    // Propagate from the ellipse to the covariance. c11 affects the ellipse only
    // through det.
    const V d_l11 = d.l11 - d.l12 * (s.c12 / s.c22);
    const V half = 1 / (2 * s.c22);
    const V d_c22 = (d_l11 * e.l11 - d.l22 * e.l22) * half - d.l12 * e.l12 / s.c22;
    const V d_c12 = -d.l12 * e.l11 / s.c22;
    V d_det = -d_l11 * e.l11 / (2 * s.det);
    V d_det0 = V{};
    Gaussian3d<V> out;
    // log2_opacity = log2(opacity) + log2(det0 / det) / 2. The last term only exists if
    // antialiased.
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
    LinearImage<V> d_image{.u = d.u, .v = d.v, .depth = d.depth, .a1 = {}, .a2 = {}};
    for (int k = 0; k < 3; ++k) {
        d_image.a1[k] = 2 * (d_det0 * into_a1[k] + filter_px2 * d_det * s.a1[k]) + d_c12 * s.a2[k];
        d_image.a2[k] =
            2 * (d_det0 * into_a2[k] + (filter_px2 * d_det + d_c22) * s.a2[k]) + d_c12 * s.a1[k];
    }

    V d_m[9], d_p[3];  // gradients of linear_rs and p
    cam.linearized_vjp(s.at, s.p, s.linear_rs, s.a1, s.a2, d_image, d_p, d_m);
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
