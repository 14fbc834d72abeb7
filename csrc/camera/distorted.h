#pragma once

// The common part of the models of distorted cameras: the point at which a projection
// is linearised, a search in a monotonic function, and the planes around a cone.
//
// The image of a distorted camera is measured in units of its focal lengths, from its
// principal point. In these units, a pixel (u, v) is at ((u - cx) / fx, (v - cy) / fy),
// and its radius is its distance from (0, 0). The image of a direction at the angle
// theta from the camera's axis has a radius of at least low(theta), which is an
// increasing function.
//
// Culling. Let a gaussian have its mean at the angle theta and the distance n from the
// eye, and let d be any vector from its mean to its ellipsoid. The image is linearised
// at the mean, so the gaussian extends from the image of its mean by at most L |d| / n,
// where L bounds the change of the image per radian. The padded window lies within the
// radius R. So the gaussian can reach the window only if
//   L |d| / n >= low(theta) - R.                                                    (1)
// Let theta_w be the angle at which low is R. Take a plane through the eye that touches
// the cone with the half angle theta_w, and let N be its unit normal, pointing away
// from the cone. The sine of the angle between the mean's direction and the plane is N
// . p / n. This angle is at most theta - theta_w, because the plane separates the two.
// With (1), it follows that
//   N . p <= n (theta - theta_w) <= |d| L (theta - theta_w) / (low(theta) - R).     (2)
// So a gaussian with theta > theta_w is not drawn if N . p > guard |d|, where guard is
// the largest value of the quotient in (2) for any theta from theta_w to the end of the
// model's range. Gaussians whose means are beyond that range are never drawn. A box
// contains the means of its gaussians, and their ellipsoids, which are symmetrical. So
// |d| is at most half of the diagonal of the box, and N . p is at least that of the
// nearest corner. The planes have the normals (±1, 0, -slope) and (0, ±1, -slope) with
// slope = tan(theta_w). The length of these normals is sqrt(1 + slope²).

#include <cmath>

#include "camera/image_terms.h"
#include "camera/pinhole.h"

namespace v3dg {

// The projection at one point: its pixel, and the rows of the Jacobian.
template <class V>
struct ImagePoint {
    V u, v;
    V j1[3], j2[3];
};

// Members that the models share, computed from an ImagePoint. The fields have the same
// meaning as those of a pinhole camera.
template <class T>
struct Distorted : Pinhole<T> {
    template <class V>
    using Point = ImagePoint<V>;

    template <class V>
    V3DG_HD V3DG_INLINE void to_pixel(const ImagePoint<V>& at, const V*, V& u, V& v) const {
        u = at.u;
        v = at.v;
    }
    template <class V, class W>
    V3DG_HD V3DG_INLINE void times_jacobian(const ImagePoint<V>& at, const W& x, const W& y,
                                            const W& z, V& a1, V& a2) const {
        a1 = at.j1[0] * x + at.j1[1] * y + at.j1[2] * z;
        a2 = at.j2[0] * x + at.j2[1] * y + at.j2[2] * z;
    }
    // A guard is relative to half of the diagonal of a box, which is at most the sum of
    // its half extents.
    static V3DG_HD void set_guard_direction(const InstanceAxes&, float direction[3]) {
        for (int k = 0; k < 3; ++k) direction[k] = 1;
    }
    // There is no bound for spheres, so every gaussian is projected.
    V3DG_HD V3DG_INLINE T sphere_scale(const SlopeLimits<T>&, T) const { return T(NAN); }
    V3DG_HD V3DG_INLINE SphereImage<T> image_of_sphere(const T*, T, T, const T&) const {
        return {.u = T(NAN), .v = T(NAN), .half = T(NAN)};
    }
};

// Computes the gradients of the matrix and of the Jacobian's rows from those of a1 and
// a2.
template <class V>
V3DG_HD V3DG_INLINE void times_jacobian_vjp(const ImagePoint<V>& at, const V m[9],
                                            const LinearImage<V>& d, V d_j1[3], V d_j2[3],
                                            V d_m[9]) {
    for (int i = 0; i < 3; ++i) {
        d_j1[i] = dot3(d.a1, m + 3 * i);
        d_j2[i] = dot3(d.a2, m + 3 * i);
        for (int k = 0; k < 3; ++k) d_m[3 * i + k] = at.j1[i] * d.a1[k] + at.j2[i] * d.a2[k];
    }
}

// Number of points at which a property of a lens is evaluated, from the axis to the end
// of a range. The factors are margins for the values between these points.
constexpr int kLensSamples = 64;
constexpr double kLensMargin = 1.02;

// Returns the smallest x in [0, most] at which an increasing function reaches `value`,
// rounded up. If it stays smaller, returns `most`.
template <class Function>
V3DG_HD double first_reaching(double value, double most, const Function& function) {
    if (!(function(most) > value)) return most;
    double low = 0, high = most;
    for (int step = 0; step < 60; ++step) {
        const double middle = (low + high) / 2;
        (function(middle) >= value ? high : low) = middle;
    }
    return high;
}

// Returns the end of the range, beginning at 0, in which is_valid() holds. It is at
// most `most`.
template <class Test>
double end_of_range(double most, const Test& is_valid) {
    constexpr int kSteps = 1024;
    double low = 0;
    for (int i = 1; i <= kSteps; ++i) {
        double high = most * i / kSteps;
        if (is_valid(high)) {
            low = high;
            continue;
        }
        for (int step = 0; step < 60; ++step) {
            const double middle = (low + high) / 2;
            (is_valid(middle) ? low : high) = middle;
        }
        return low;
    }
    return most;
}

// Returns the largest value of a function in [first, last], with a margin.
template <class Function>
V3DG_HD double largest_in(double first, double last, const Function& function) {
    double most = 0;
    for (int i = 0; i <= kLensSamples; ++i)
        most = max_of(most, function(first + (last - first) * i / kLensSamples));
    return kLensMargin * most;
}

// Returns the largest radius in a window of the image that is extended by pad_px.
template <class T>
V3DG_HD double radius_of_window(const Pinhole<T>& image, const ImagePart& part, double pad_px) {
    const double x = max_of(fabs(part.x0 - pad_px - double(image.cx)),
                            fabs(part.x1 + pad_px - double(image.cx))) /
                     double(image.fx);
    const double y = max_of(fabs(part.y0 - pad_px - double(image.cy)),
                            fabs(part.y1 + pad_px - double(image.cy))) /
                     double(image.fy);
    return sqrt(x * x + y * y);
}
template <class T>
V3DG_HD double radius_of_image(const Pinhole<T>& image) {
    return radius_of_window(image, {0, 0, double(image.width), double(image.height)}, 0);
}

// Returns the sides of a pyramid around the cone with the half angle atan(slope).
V3DG_HD inline FrustumSides sides_of_cone(double slope, double guard) {
    FrustumSides sides;
    for (int side = 0; side < 4; ++side) {
        sides.slope[side] = slope;
        sides.guard[side] = static_cast<float>(guard);
    }
    return sides;
}

}  // namespace v3dg
