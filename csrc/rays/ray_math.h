#pragma once

// Formulas for a gaussian on the rays from one point: its largest value on each ray,
// the distance of that value, and the directions that the gaussian can reach.
//
// Nothing is projected or linearised. Let p be the mean of the gaussian relative to the
// eye, r_k its axes (of unit length) and s_k its standard deviations. Along the ray
// with the unit direction d, the smallest squared Mahalanobis distance is
//   q(d) = |M p x M d|² / |M d|²,  where the rows of M are r_k / s_k.
// The identity M a x M b = det(M) M^-T (a x b) and multiplication by (s_0 s_1 s_2)²
// above and below give
//   q(d) = sum_k (s_k r_k . (p x d))² / sum_k (s_i s_j r_k . d)²,  i and j not k.
// This form divides by no deviation, and subtracts no large numbers. The distance at
// which q(d) is reached, t(d) = (M p . M d) / |M d|², uses the same terms.
//
// A screen-space filter becomes a filter of angles: the variance f in rad² adds f |p|²
// to every s_k². This is exact for the projection along the direction of the mean,
// because the projection of a sum is the sum of the projections, and a multiple of the
// identity stays one. The determinant of the projected covariance along the unit
// direction u is sum_k (s_i s_j r_k . u)², a sum of positive terms. All lengths are
// divided by |p|.

#include "math/gaussian.h"
#include "math/solid_angle.h"
#include "math/vec.h"
#include "math/view.h"
#include "project/project_math.h"

namespace v3dg {

// A gaussian as seen from the eye: the unit direction and the distance of its mean, its
// axes, and its standard deviations in radians.
template <class V>
struct SeenGaussian {
    V direction[3], distance;
    V axis[3][3];
    V sigma[3];
    V log2_opacity;
    V determinant;  // determinant of the projected covariance, rad⁴
};

// Returns sum_k (s_i s_j r_k . u)². The arguments are squared deviations.
template <class V>
V3DG_HD V3DG_INLINE V projected_determinant(const V variance[3], const V along[3]) {
    V sum = V{};
    for (int k = 0; k < 3; ++k) {
        const V others = variance[(k + 1) % 3] * variance[(k + 2) % 3];
        sum += others * along[k] * along[k];
    }
    return sum;
}

// Returns the gaussian as seen from the eye. `filter_rad2` is the variance of the
// filter. Appearance explains the other two settings.
template <class V, class T>
V3DG_HD V3DG_INLINE SeenGaussian<V> see_gaussian(const Gaussian3d<V>& g, const ModelView<T>& view,
                                                 T filter_rad2, bool antialiased, bool is_limited) {
    SeenGaussian<V> seen;
    V p[3], rotation[9];
    to_view(view, g.mean, p);
    seen.distance = sqrt_of(dot3(p, p));
    for (int i = 0; i < 3; ++i) seen.direction[i] = p[i] / seen.distance;
    rotation_of_quat(g.quat, rotation);
    const T model_scale = sqrt_of(dot3(view.linear, view.linear));
    V variance[3], along[3];
    for (int k = 0; k < 3; ++k) {
        for (int i = 0; i < 3; ++i)
            seen.axis[k][i] =
                (view.linear[3 * i] * rotation[k] + view.linear[3 * i + 1] * rotation[3 + k] +
                 view.linear[3 * i + 2] * rotation[6 + k]) *
                (1 / model_scale);
        const V sigma = model_scale * g.scale[k] / seen.distance;
        variance[k] = sigma * sigma;
        along[k] = dot3(seen.axis[k], seen.direction);
    }
    const V unfiltered = projected_determinant(variance, along);
    V filter = all_lanes<V>(filter_rad2);
    if (is_limited) filter = min_of(filter, T(kMostFilterOfVariance) * sqrt_of(unfiltered));
    for (int k = 0; k < 3; ++k) {
        variance[k] += filter;
        seen.sigma[k] = sqrt_of(variance[k]);
    }
    seen.determinant = projected_determinant(variance, along);
    seen.log2_opacity = log2_of(g.opacity);
    if (antialiased) seen.log2_opacity += T(0.5) * log2_of(unfiltered / seen.determinant);
    return seen;
}

// Returns whether a gaussian can be seen at all. Its determinant must be positive and
// finite, and its alpha at the mean at least 1/255.
template <class V>
V3DG_HD V3DG_INLINE auto is_visible(const SeenGaussian<V>& seen, const V& opacity) {
    const V huge = all_lanes<V>(kLargest<Lane<V>>);
    return (seen.determinant > V{}) & (seen.determinant < huge) & (opacity < huge) &
           (seen.log2_opacity >= all_lanes<V>(Lane<V>(kLog2MinAlpha))) & (seen.distance < huge) &
           (seen.distance > V{});
}

// The coefficients of a gaussian for evaluating it on rays.
template <class V>
struct RayShape {
    V across[9];  // rows: kFalloffScale s_k (r_k x p), divided by the largest s
    V along[9];   // rows: s_i s_j r_k, divided by the largest s²
    V range[3];   // |p| times the product of along^T and along p
    V log2_opacity;
};

template <class V>
V3DG_HD V3DG_INLINE RayShape<V> shape_on_rays(const SeenGaussian<V>& seen) {
    using T = Lane<V>;
    const V most = max_of(seen.sigma[0], max_of(seen.sigma[1], seen.sigma[2]));
    const V inverse = 1 / most;
    V share[3];
    for (int k = 0; k < 3; ++k) share[k] = seen.sigma[k] * inverse;
    RayShape<V> shape;
    for (int i = 0; i < 3; ++i) shape.range[i] = V{};
    for (int k = 0; k < 3; ++k) {
        V turned[3];
        cross3(seen.axis[k], seen.direction, turned);
        const V others = share[(k + 1) % 3] * share[(k + 2) % 3];
        const V forward = others * others * dot3(seen.axis[k], seen.direction) * seen.distance;
        for (int i = 0; i < 3; ++i) {
            shape.across[3 * k + i] = T(kFalloffScale) * share[k] * inverse * turned[i];
            shape.along[3 * k + i] = others * seen.axis[k][i];
            shape.range[i] += forward * seen.axis[k][i];
        }
    }
    shape.log2_opacity = seen.log2_opacity;
    return shape;
}

// The largest value of a gaussian on a ray: alpha is 2^(log2_opacity - falloff).
template <class V>
struct RayHit {
    V falloff, range;
};

// Evaluates a gaussian on the ray with a unit direction. If the largest value is behind
// the eye, the range is negative.
template <class V, class T>
V3DG_HD V3DG_INLINE RayHit<V> hit_of(const RayShape<T>& shape, const V& x, const V& y, const V& z) {
    V above = V{}, below = V{};
    for (int k = 0; k < 3; ++k) {
        const T* row = shape.across + 3 * k;
        const V a = row[0] * x + row[1] * y + row[2] * z;
        above += a * a;
        row = shape.along + 3 * k;
        const V b = row[0] * x + row[1] * y + row[2] * z;
        below += b * b;
    }
    const V inverse = 1 / below;
    const V forward = shape.range[0] * x + shape.range[1] * y + shape.range[2] * z;
    return {above * inverse, forward * inverse};
}

// A box of directions. Azimuths go from `azimuth0` to `azimuth1` around the z axis, and
// elevations are measured from the xy plane; all are in radians. A box that spans a
// full turn contains every azimuth.
template <class V>
struct DirectionBox {
    V azimuth0, azimuth1, elevation0, elevation1;
};

// Margins of a DirectionBox for rounding: in radians, and relative to its half size.
constexpr float kDirectionMargin = 4e-6f, kRelativeDirectionMargin = 1e-4f;

// Returns a box that contains every direction for which q <= reach2.
//
// Take the plane that touches the unit sphere at u, the direction of the mean, with the
// axes e (east) and n (north). In this plane, the image of the ellipsoid q = reach2 is
// a conic. Its extent along e follows from the lines x = k that touch it:
//   k = (-c S_eu ± sqrt(c² S_eu² + c S_ee (1 - c S_uu))) / (1 - c S_uu), c = reach2,
// where S is the covariance. The extent along n has the same form. If 1 - c S_uu is not
// positive, the ellipsoid extends to the side of the eye or behind it, and the box
// contains all directions.
//
// Let sin and cos be those of the elevation of u. A point (x, y) of the plane has the
// coordinate cos - y sin away from the z axis in the direction of u, the coordinate x
// across, and the height sin + y cos. If the first coordinate can be 0, the box
// contains a pole. Otherwise, the azimuth differs from that of u by at most |x| over
// the smallest first coordinate. For x = 0, the elevation differs by at most y. For x
// != 0, a point below the horizon has a higher elevation: its distance a from the axis
// grows by at most x² / 2a, and its elevation by at most |h| / (h² + a²) times as much,
// where h is its height. The same holds, mirrored, above the horizon.
template <class V>
V3DG_HD V3DG_INLINE DirectionBox<V> directions_of(const SeenGaussian<V>& seen, const V& reach2) {
    using T = Lane<V>;
    const T turn = T(2 * kPi);
    const V* u = seen.direction;
    const V horizontal = sqrt_of(u[0] * u[0] + u[1] * u[1]);
    const auto is_pole = horizontal < all_lanes<V>(T(1e-6));
    const V cosine = is_pole ? all_lanes<V>(T(1)) : u[0] / horizontal;
    const V sine = is_pole ? V{} : u[1] / horizontal;
    const V east[3] = {-sine, cosine, V{}};
    const V north[3] = {-u[2] * cosine, -u[2] * sine, horizontal};
    V ee = V{}, nn = V{}, uu = V{}, eu = V{}, nu = V{};
    for (int k = 0; k < 3; ++k) {
        const V e = seen.sigma[k] * dot3(seen.axis[k], east);
        const V n = seen.sigma[k] * dot3(seen.axis[k], north);
        const V along = seen.sigma[k] * dot3(seen.axis[k], u);
        ee += e * e;
        nn += n * n;
        uu += along * along;
        eu += e * along;
        nu += n * along;
    }
    const V rest = 1 - reach2 * uu;
    const auto is_beside = rest <= all_lanes<V>(T(1e-3));
    const V scale = 1 / rest;
    const V half_x = sqrt_of(reach2 * (reach2 * eu * eu + ee * rest)) * scale;
    const V half_y = sqrt_of(reach2 * (reach2 * nu * nu + nn * rest)) * scale;
    const V margin_x = kDirectionMargin + kRelativeDirectionMargin * half_x;
    const V margin_y = kDirectionMargin + kRelativeDirectionMargin * half_y;
    const V x0 = -reach2 * eu * scale - half_x - margin_x;
    const V x1 = -reach2 * eu * scale + half_x + margin_x;
    const V y0 = -reach2 * nu * scale - half_y - margin_y;
    const V y1 = -reach2 * nu * scale + half_y + margin_y;
    const V most_x = max_of(-x0, x1), most_y = max_of(-y0, y1);
    const V latitude = atan2_of(u[2], horizontal), longitude = atan2_of(sine, cosine);

    const V low_axis = horizontal - y0 * u[2], high_axis = horizontal - y1 * u[2];
    const V least_axis = min_of(low_axis, high_axis);
    const auto has_pole = least_axis <= all_lanes<V>(T(1e-5));
    const V low = u[2] + y0 * horizontal, high = u[2] + y1 * horizontal;
    const V half_x2 = T(0.5) * most_x * most_x;
    const V low_rise = max_of(low, V{}) * half_x2 / (low_axis * (low * low + low_axis * low_axis));
    const V high_rise =
        max_of(-high, V{}) * half_x2 / (high_axis * (high * high + high_axis * high_axis));
    const V radius = sqrt_of(most_x * most_x + most_y * most_y);
    const V all = all_lanes<V>(turn);
    const V elevation0 = has_pole ? latitude - radius : latitude + y0 - low_rise;
    const V elevation1 = has_pole ? latitude + radius : latitude + y1 + high_rise;
    DirectionBox<V> box;
    box.azimuth0 = is_beside | has_pole ? -all : longitude + x0 / least_axis - kDirectionMargin;
    box.azimuth1 = is_beside | has_pole ? all : longitude + x1 / least_axis + kDirectionMargin;
    box.elevation0 = is_beside ? -all : elevation0 - kDirectionMargin;
    box.elevation1 = is_beside ? all : elevation1 + kDirectionMargin;
    return box;
}

// Returns a lower bound on the distances of the largest values on all rays with
// q <= reach2.
//
// Let x = p + y be such a place, S the covariance, u the direction of the mean, and let
// lengths be divided by |p|. The value is stationary along the ray, so x^T S^-1 y = 0,
// which means u^T S^-1 y = -q. Split S^1/2 u into its part along S^-1/2 u and the rest
// a. With v = 1 / (u^T S^-1 u), |a|² = u^T S u - v, and
//   u . y >= -q v - |a| sqrt(q).
// The distance of x is at least u . x = 1 + u . y. For a round gaussian, a is 0: all of
// its places are about as far away as its mean. The nearest point of the ellipsoid is a
// second bound.
template <class V>
V3DG_HD V3DG_INLINE V nearest_of(const SeenGaussian<V>& seen, const V& reach2) {
    using T = Lane<V>;
    V uu = V{};
    for (int k = 0; k < 3; ++k) {
        const V along = seen.sigma[k] * dot3(seen.axis[k], seen.direction);
        uu += along * along;
    }
    const V volume = seen.sigma[0] * seen.sigma[1] * seen.sigma[2];
    const V depth = volume / sqrt_of(seen.determinant);
    const V depth2 = min_of(depth * depth, uu);  // v
    const V across2 = uu - depth2 + T(1e-5) * uu;
    const V spread = min_of(reach2 * depth2 + sqrt_of(reach2 * across2), sqrt_of(reach2 * uu));
    const V share = T(1 - 1e-5) - spread * T(1 + 1e-5);
    return max_of(share, V{}) * seen.distance;
}

}  // namespace v3dg
