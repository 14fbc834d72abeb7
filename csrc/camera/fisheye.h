#pragma once

// OpenCV's fisheye lens, which COLMAP calls OPENCV_FISHEYE. The image of a point at the
// angle theta from the camera's axis is in the direction of the point's x and y, at the
// radius
//   rho(theta) = theta (1 + k1 theta² + k2 theta⁴ + k3 theta⁶ + k4 theta⁸)
// in units of the focal lengths. Angles may exceed 90 degrees. Source: OpenCV's
// documentation of its fisheye model.
//
// With h² = x² + y² and n² = h² + z², the image is (x g, y g) with g = rho / h. Its
// Jacobian is [g + x² e, x y e, x gz; x y e, g + y² e, y gz]. Here, e is twice the
// derivative of g with respect to h², and gz is the derivative with respect to z. The
// depth of a point is n, its distance from the eye.
//
// The valid range ends where rho stops increasing, or near 180 degrees, where a point
// would become a circle. Points outside this range are not drawn. As for a pinhole
// camera, the Jacobian is computed at an angle that is clamped to kFovMargin outside
// the image.

#include "camera/distorted.h"
#include "math/solid_angle.h"

namespace v3dg {

// rho at one angle, and its first two derivatives. `curvature` is the second one,
// divided by the angle.
template <class V>
struct FisheyeRadius {
    V value, slope, curvature;
};

// g and its derivatives at one point.
template <class V>
struct FisheyeFactor {
    V g, e, gz;
};

template <class T>
struct Fisheye : Distorted<T> {
    T k[4];
    T clamp_angle, clamp_sin, clamp_cos;  // angle at which the Jacobian is clamped
    T valid_angle, valid_cos;             // end of the valid range

    template <class U>
    V3DG_HD Fisheye<U> rounded_to() const {
        return {{Pinhole<T>::template rounded_to<U>()},
                {U(k[0]), U(k[1]), U(k[2]), U(k[3])},
                U(clamp_angle),
                U(clamp_sin),
                U(clamp_cos),
                U(valid_angle),
                U(valid_cos)};
    }

    template <class V>
    V3DG_HD V3DG_INLINE V depth_of(const V p[3]) const {
        const V n = sqrt_of(dot3(p, p));
        return p[2] >= n * valid_cos ? n : all_lanes<V>(T(-1));
    }

    V3DG_HD V3DG_INLINE SlopeLimits<T> limits() const { return {}; }

    template <class V>
    V3DG_HD V3DG_INLINE ImagePoint<V> linearized(const SlopeLimits<T>&, const V p[3]) const {
        const V h2 = p[0] * p[0] + p[1] * p[1], n2 = h2 + p[2] * p[2];
        const V h = sqrt_of(h2), n = sqrt_of(n2);
        const V angle = atan2_of(h, p[2]);
        ImagePoint<V> at;
        const V g = factor_of(radius(angle).value, angle, h, n);
        at.u = this->fx * p[0] * g + this->cx;
        at.v = this->fy * p[1] * g + this->cy;
        V c[3];
        clamp(p, angle, h, n, c);
        const V limit = all_lanes<V>(clamp_angle);
        const FisheyeFactor<V> f = factors(c, min_of(angle, limit));
        at.j1[0] = this->fx * (f.g + c[0] * c[0] * f.e);
        at.j1[1] = this->fx * c[0] * c[1] * f.e;
        at.j1[2] = this->fx * c[0] * f.gz;
        at.j2[0] = this->fy * c[0] * c[1] * f.e;
        at.j2[1] = this->fy * (f.g + c[1] * c[1] * f.e);
        at.j2[2] = this->fy * c[1] * f.gz;
        return at;
    }

    template <class V>
    V3DG_HD V3DG_INLINE void linearized_vjp(const ImagePoint<V>& at, const V p[3], const V m[9],
                                            const V*, const V*, const LinearImage<V>& d, V d_p[3],
                                            V d_m[9]) const {
        V d_j1[3], d_j2[3];
        times_jacobian_vjp(at, m, d, d_j1, d_j2, d_m);
        const V h2 = p[0] * p[0] + p[1] * p[1], n2 = h2 + p[2] * p[2];
        const V h = sqrt_of(h2), n = sqrt_of(n2);
        const V angle = atan2_of(h, p[2]);
        V c[3], d_c[3];
        clamp(p, angle, h, n, c);
        jacobian_vjp(c, min_of(angle, all_lanes<V>(clamp_angle)), d_j1, d_j2, d_c);
        clamp_vjp(p, angle, h, n, d_c, d_p);
        const FisheyeFactor<V> f = factors(p, angle);
        const V d_u = this->fx * d.u, d_v = this->fy * d.v;
        const V d_g = d_u * p[0] + d_v * p[1];
        const V depth_slope = d.depth / n;
        d_p[0] += d_u * f.g + d_g * f.e * p[0] + depth_slope * p[0];
        d_p[1] += d_v * f.g + d_g * f.e * p[1] + depth_slope * p[1];
        d_p[2] += d_g * f.gz + depth_slope * p[2];
    }

    // The largest density of pixels over all directions in the image.
    V3DG_HD T px2_per_steradian() const {
        const double most = first_reaching(radius_of_image(*this), double(valid_angle),
                                           [&](double angle) { return radius_at(angle).value; });
        const double density = largest_in(
            0, most, [&](double angle) { return radius_at(angle).slope * across_at(angle); });
        return T(double(this->fx) * double(this->fy) * density);
    }

    // See camera/distorted.h.
    V3DG_HD FrustumSides sides_of_part(const ImagePart& part, double pad_px) const {
        constexpr double kMostAngle = 1.5;  // largest half angle of a cone that planes
                                            // enclose
        const auto low = [&](double angle) { return radius_at(angle).value; };
        const double radius = radius_of_window(*this, part, pad_px);
        const double last = double(valid_angle);
        const double first = first_reaching(radius, last, low);
        if (first > kMostAngle) return sides_of_cone(0, INFINITY);
        const double slope = tan(first);
        double guard = 0;
        if (low(last) > radius) {
            const double stretch = largest_in(0, double(clamp_angle), [&](double angle) {
                return max_of(radius_at(angle).slope, across_at(angle));
            });
            guard = stretch * sqrt(1 + slope * slope) *
                    largest_in(first + 1e-3 * (last - first), last, [&](double angle) {
                        return (angle - first) / (low(angle) - radius);
                    });
        }
        return sides_of_cone(slope, guard);
    }

    // With a near distance instead of a near plane, no plane bounds what is too near.
    // So this offset culls nothing.
    V3DG_HD double front_offset(const InstanceAxes&, double) const { return -1e30; }

    // Stereo cameras cannot have lenses, so there is one eye.
    template <class Eye>
    static V3DG_HD FrustumSides sides_of(const Eye eyes[2], int, double pad_px) {
        return eyes[0].fisheye().sides_of_part(eyes[0], pad_px);
    }

    // Computes the ranges. All other fields must be set.
    void set_ranges() {
        constexpr double kMostAngle = 0.95 * kPi;
        const double end =
            end_of_range(kMostAngle, [&](double angle) { return radius_at(angle).slope > 0; });
        valid_angle = T(end);
        valid_cos = T(cos(end));
        const double clamped = first_reaching((1 + kFovMargin) * radius_of_image(*this), end,
                                              [&](double angle) { return radius_at(angle).value; });
        clamp_angle = T(clamped);
        clamp_sin = T(sin(clamped));
        clamp_cos = T(cos(clamped));
    }

  private:
    template <class V>
    V3DG_HD V3DG_INLINE FisheyeRadius<V> radius(const V& angle) const {
        const V t = angle * angle;
        FisheyeRadius<V> out;
        out.value = angle * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))));
        out.slope = 1 + t * (3 * k[0] + t * (5 * k[1] + t * (7 * k[2] + t * (9 * k[3]))));
        out.curvature = 6 * k[0] + t * (20 * k[1] + t * (42 * k[2] + t * (72 * k[3])));
        return out;
    }
    V3DG_HD FisheyeRadius<double> radius_at(double angle) const {
        return rounded_to<double>().radius(angle);
    }
    // The change of the image per radian, across the radius.
    V3DG_HD double across_at(double angle) const {
        return angle > 1e-6 ? radius_at(angle).value / sin(angle) : 1.0;
    }

    // Returns whether h is so small that the series must be used.
    template <class V>
    static V3DG_HD V3DG_INLINE auto is_near_axis(const V& h, const V& n) {
        return h < n * T(0.01);
    }

    // Returns g for a radius rho at an angle. Close to the axis, angle / h = (1 + h² /
    // (6 n²)) / n.
    template <class V>
    V3DG_HD V3DG_INLINE V factor_of(const V& rho, const V& angle, const V& h, const V& n) const {
        const V sine = h / n, t = angle * angle;
        const V near_axis = (1 + t * k[0]) * (1 + sine * sine * T(1.0 / 6)) / n;
        return is_near_axis(h, n) ? near_axis : rho / max_of(h, all_lanes<V>(kTiny));
    }

    template <class V>
    V3DG_HD V3DG_INLINE FisheyeFactor<V> factors(const V p[3], const V& angle) const {
        const V h2 = p[0] * p[0] + p[1] * p[1], n2 = h2 + p[2] * p[2];
        const V h = sqrt_of(h2), n = sqrt_of(n2);
        const FisheyeRadius<V> rho = radius(angle);
        FisheyeFactor<V> out;
        out.g = factor_of(rho.value, angle, h, n);
        out.gz = -rho.slope / n2;
        const V near_axis = T(2) * (k[0] - T(1.0 / 3)) / (n * n2);
        out.e = is_near_axis(h, n)
                    ? near_axis
                    : (rho.slope * p[2] / n2 - out.g) / max_of(h2, all_lanes<V>(kTiny));
        return out;
    }

    // If the angle of a point exceeds the clamped angle, moves the point to that angle,
    // at the same distance.
    template <class V>
    V3DG_HD V3DG_INLINE void clamp(const V p[3], const V& angle, const V& h, const V& n,
                                   V c[3]) const {
        const auto is_clamped = angle > all_lanes<V>(clamp_angle);
        const V shrink = n * clamp_sin / max_of(h, all_lanes<V>(kTiny));
        c[0] = is_clamped ? shrink * p[0] : p[0];
        c[1] = is_clamped ? shrink * p[1] : p[1];
        c[2] = is_clamped ? n * clamp_cos : p[2];
    }
    template <class V>
    V3DG_HD V3DG_INLINE void clamp_vjp(const V p[3], const V& angle, const V& h, const V& n,
                                       const V d_c[3], V d_p[3]) const {
        const auto is_clamped = angle > all_lanes<V>(clamp_angle);
        const V inv_h = 1 / max_of(h, all_lanes<V>(kTiny)), inv_n = 1 / n;
        const V shrink = n * clamp_sin * inv_h;
        const V d_shrink = clamp_sin * (p[0] * d_c[0] + p[1] * d_c[1]);
        // The derivatives of 1 / h and of n.
        const V by_h = d_shrink * n * inv_h * inv_h * inv_h;
        const V by_n = (d_shrink * inv_h + clamp_cos * d_c[2]) * inv_n;
        d_p[0] = is_clamped ? shrink * d_c[0] + p[0] * (by_n - by_h) : d_c[0];
        d_p[1] = is_clamped ? shrink * d_c[1] + p[1] * (by_n - by_h) : d_c[1];
        d_p[2] = is_clamped ? p[2] * by_n : d_c[2];
    }

    // Computes the gradients of a point from those of its Jacobian.
    template <class V>
    V3DG_HD V3DG_INLINE void jacobian_vjp(const V c[3], const V& angle, const V d_j1[3],
                                          const V d_j2[3], V d_c[3]) const {
        const V x = c[0], y = c[1], z = c[2];
        const V h2 = x * x + y * y, n2 = h2 + z * z;
        const V h = sqrt_of(h2), n = sqrt_of(n2);
        const FisheyeRadius<V> rho = radius(angle);
        const FisheyeFactor<V> f = factors(c, angle);
        // The second derivative of rho, divided by h. Close to the axis, angle / h is 1
        // / n.
        const auto is_near = is_near_axis(h, n);
        const V angle_h = is_near ? 1 / n : angle / max_of(h, all_lanes<V>(kTiny));
        const V bend = rho.curvature * angle_h;
        const V inv_n2 = 1 / n2, inv_n4 = inv_n2 * inv_n2;
        const V gz_z = (bend * h2 + 2 * z * rho.slope) * inv_n4;
        const V e_z = (2 * rho.slope - bend * z) * inv_n4;
        const V far_e = ((T(0.5) * bend * z - rho.slope) * z * inv_n4 - T(1.5) * f.e) /
                        max_of(h2, all_lanes<V>(kTiny));
        const V e_h2 = is_near ? V{} : far_e;  // derivative with respect to h²; its
                                               // products vanish close to the axis
        const V x1 = this->fx * d_j1[0], y1 = this->fx * d_j1[1], z1 = this->fx * d_j1[2];
        const V x2 = this->fy * d_j2[0], y2 = this->fy * d_j2[1], z2 = this->fy * d_j2[2];
        const V d_g = x1 + y2;
        const V d_e = x * x * x1 + x * y * (y1 + x2) + y * y * y2;
        const V d_gz = x * z1 + y * z2;
        const V d_h2 = T(0.5) * (d_g * f.e + d_gz * e_z) + d_e * e_h2;
        d_c[0] = 2 * x * (f.e * x1 + d_h2) + y * f.e * (y1 + x2) + f.gz * z1;
        d_c[1] = 2 * y * (f.e * y2 + d_h2) + x * f.e * (y1 + x2) + f.gz * z2;
        d_c[2] = d_g * f.gz + d_e * e_z + d_gz * gz_z;
    }

    static constexpr T kTiny = T(1e-30);
};

}  // namespace v3dg
