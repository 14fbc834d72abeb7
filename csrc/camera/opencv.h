#pragma once

// A pinhole camera with OpenCV's radial and tangential distortion, which COLMAP calls
// FULL_OPENCV. Simpler models, down to SIMPLE_RADIAL, set the other coefficients to
// zero. Let a point have the slopes x = X / Z and y = Y / Z, with r² = x² + y² and
//   R = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶).
// Its image is at (fx x' + cx, fy y' + cy) with
//   x' = x R + 2 p1 x y + p2 (r² + 2 x²),  y' = y R + p1 (r² + 2 y²) + 2 p2 x y.
// Source: OpenCV's documentation of camera calibration.
//
// Let q = (p2, p1) and s = (x, y), and let R' be the derivative of R with respect to
// r². The map is (x', y') = s R + 2 (q . s) s + |s|² q. Its derivative with respect to
// s is the symmetric matrix
//   D = R I + 2 R' s sᵀ + 2 (q . s) I + 2 (q sᵀ + s qᵀ).
// The last two terms change D by at most 6 |q| r, so its eigenvalues are at least
// min(R, R + 2 r² R') - 6 |q| r. In a disc in which this is positive, the map is one to
// one, and the radius of an image is at least low(r) = r R - 3 |q| r², which increases.
// That disc is the valid range. Points outside it, beyond the first fold, are not
// drawn. As for a pinhole camera, the slopes at which the Jacobian is computed are
// clamped: those farther than kFovMargin outside the image are moved towards the axis.

#include "camera/distorted.h"

namespace v3dg {

// The value of R at one r², and its derivatives with respect to r².
template <class V>
struct RadialFactor {
    V value, slope, curvature;
};

template <class T>
struct OpenCv : Distorted<T> {
    T k[6], p1, p2;
    T clamp_slope;  // radius to which slopes are clamped in the Jacobian
    T valid_slope;  // end of the valid range

    template <class U>
    V3DG_HD OpenCv<U> rounded_to() const {
        OpenCv<U> out{{Pinhole<T>::template rounded_to<U>()},
                      {},
                      U(p1),
                      U(p2),
                      U(clamp_slope),
                      U(valid_slope)};
        for (int i = 0; i < 6; ++i) out.k[i] = U(k[i]);
        return out;
    }

    template <class V>
    V3DG_HD V3DG_INLINE V depth_of(const V p[3]) const {
        const V most = valid_slope * p[2];
        return p[0] * p[0] + p[1] * p[1] <= most * most ? p[2] : all_lanes<V>(T(-1));
    }

    V3DG_HD V3DG_INLINE SlopeLimits<T> limits() const { return {}; }

    template <class V>
    V3DG_HD V3DG_INLINE ImagePoint<V> linearized(const SlopeLimits<T>&, const V p[3]) const {
        const V inv_z = 1 / p[2], x = p[0] * inv_z, y = p[1] * inv_z;
        const V r2 = x * x + y * y;
        const V factor = radial(r2).value;
        ImagePoint<V> at;
        at.u = this->fx * (x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + this->cx;
        at.v = this->fy * (y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + this->cy;
        const V shrink = shrink_of(r2);
        set_jacobian(inv_z, shrink * x, shrink * y, at);
        return at;
    }

    template <class V>
    V3DG_HD V3DG_INLINE void linearized_vjp(const ImagePoint<V>& at, const V p[3], const V m[9],
                                            const V*, const V*, const LinearImage<V>& d, V d_p[3],
                                            V d_m[9]) const {
        V d_j1[3], d_j2[3];
        times_jacobian_vjp(at, m, d, d_j1, d_j2, d_m);
        const V inv_z = 1 / p[2], x = p[0] * inv_z, y = p[1] * inv_z;
        const V r2 = x * x + y * y;
        const V shrink = shrink_of(r2);
        V d_x, d_y;
        jacobian_vjp(inv_z, shrink * x, shrink * y, d_j1, d_j2, d_x, d_y);
        // Clamped slopes only change their direction around the axis, so their length
        // has no gradient.
        const V along = r2 > all_lanes<V>(clamp_slope * clamp_slope)
                            ? (x * d_x + y * d_y) / max_of(r2, all_lanes<V>(kTiny))
                            : V{};
        d_x = shrink * (d_x - along * x);
        d_y = shrink * (d_y - along * y);
        V d11, d12, d22;
        set_derivative(radial(r2), x, y, d11, d12, d22);
        const V d_u = this->fx * d.u, d_v = this->fy * d.v;
        d_x += d_u * d11 + d_v * d12;
        d_y += d_u * d12 + d_v * d22;
        d_p[0] = d_x * inv_z;
        d_p[1] = d_y * inv_z;
        d_p[2] = d.depth - inv_z * (dot3(at.j1, d_j1) + dot3(at.j2, d_j2) + x * d_x + y * d_y);
    }

    // The density at the axis of a pinhole camera, times a bound on the determinant of
    // D in the image. The density also grows away from the axis because of the slopes
    // alone; as for a pinhole camera, this growth is ignored.
    V3DG_HD T px2_per_steradian() const {
        const double most = first_reaching(radius_of_image(*this), double(valid_slope),
                                           [&](double r) { return lowest_radius(r); });
        const double area = largest_in(0, most, [&](double r) {
            const Stretch stretch = stretch_at(r);
            return stretch.along * stretch.across;
        });
        return T(double(this->fx) * double(this->fy) * area);
    }

    // See camera/distorted.h. Here, slopes replace angles. The condition (1) becomes
    // |D| sqrt(1 + c²) |d| / Z >= low(r) - R for the clamped radius c, and a normal N =
    // (±1, 0, -slope) has N . p <= Z (r - slope).
    V3DG_HD FrustumSides sides_of_part(const ImagePart& part, double pad_px) const {
        const auto low = [&](double r) { return lowest_radius(r); };
        const double radius = radius_of_window(*this, part, pad_px);
        const double most = double(valid_slope);
        const double slope = first_reaching(radius, most, low);
        double guard = 0;
        if (low(most) > radius) {
            const double stretch = largest_in(0, double(clamp_slope), [&](double r) {
                return stretch_at(r).most() * sqrt(1 + r * r);
            });
            const double first = atan(slope), last = atan(most);
            guard = stretch * largest_in(first + 1e-3 * (last - first), last, [&](double angle) {
                        const double r = tan(angle);
                        return (r - slope) / (low(r) - radius);
                    });
        }
        return sides_of_cone(slope, guard);
    }

    // Stereo cameras cannot have lenses, so there is one eye.
    template <class Eye>
    static V3DG_HD FrustumSides sides_of(const Eye eyes[2], int, double pad_px) {
        return eyes[0].opencv().sides_of_part(eyes[0], pad_px);
    }

    // Computes the ranges. All other fields must be set.
    void set_ranges() {
        constexpr double kMostAngle = 1.5608;  // atan(100)
        const double end = end_of_range(kMostAngle, [&](double angle) {
            const Stretch stretch = stretch_at(tan(angle));
            return stretch.least > 0 && stretch.most() < INFINITY;
        });
        valid_slope = T(tan(end));
        clamp_slope = T(first_reaching((1 + kFovMargin) * radius_of_image(*this), tan(end),
                                       [&](double r) { return lowest_radius(r); }));
    }

  private:
    static constexpr T kTiny = T(1e-30);

    // Bounds on the eigenvalues of D at a radius: those of the radial part along and
    // across the radius, and the smallest one.
    struct Stretch {
        double along, across, least;

        V3DG_HD double most() const { return max_of(along, across); }
    };

    template <class V>
    V3DG_HD V3DG_INLINE RadialFactor<V> radial(const V& r2) const {
        const V above = 1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]));
        const V above_slope = k[0] + r2 * (2 * k[1] + r2 * (3 * k[2]));
        const V above_curvature = 2 * k[1] + r2 * (6 * k[2]);
        const V below = 1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]));
        const V below_slope = k[3] + r2 * (2 * k[4] + r2 * (3 * k[5]));
        const V below_curvature = 2 * k[4] + r2 * (6 * k[5]);
        const V inverse = 1 / below;
        RadialFactor<V> out;
        out.value = above * inverse;
        out.slope = (above_slope - out.value * below_slope) * inverse;
        out.curvature =
            (above_curvature - 2 * out.slope * below_slope - out.value * below_curvature) * inverse;
        return out;
    }

    V3DG_HD Stretch stretch_at(double r) const {
        const OpenCv<double> lens = rounded_to<double>();
        const RadialFactor<double> factor = lens.radial(r * r);
        const double tangential = 6 * sqrt(lens.p1 * lens.p1 + lens.p2 * lens.p2) * r;
        const double along = factor.value + 2 * r * r * factor.slope;
        return {.along = fabs(along) + tangential,
                .across = fabs(factor.value) + tangential,
                .least = min_of(along, factor.value) - tangential};
    }

    // low(r)
    V3DG_HD double lowest_radius(double r) const {
        const OpenCv<double> lens = rounded_to<double>();
        const double tangential = 3 * sqrt(lens.p1 * lens.p1 + lens.p2 * lens.p2) * r * r;
        return r * lens.radial(r * r).value - tangential;
    }

    // Returns the factor that slopes are multiplied by in the Jacobian.
    template <class V>
    V3DG_HD V3DG_INLINE V shrink_of(const V& r2) const {
        const V limit = all_lanes<V>(clamp_slope);
        return r2 > limit * limit ? limit / sqrt_of(r2) : all_lanes<V>(T(1));
    }

    // Sets D, which is symmetric.
    template <class V>
    V3DG_HD V3DG_INLINE void set_derivative(const RadialFactor<V>& factor, const V& x, const V& y,
                                            V& d11, V& d12, V& d22) const {
        const V twice = 2 * factor.slope;
        d11 = factor.value + twice * x * x + 2 * p1 * y + 6 * p2 * x;
        d12 = twice * x * y + 2 * p1 * x + 2 * p2 * y;
        d22 = factor.value + twice * y * y + 6 * p1 * y + 2 * p2 * x;
    }

    template <class V>
    V3DG_HD V3DG_INLINE void set_jacobian(const V& inv_z, const V& x, const V& y,
                                          ImagePoint<V>& at) const {
        V d11, d12, d22;
        set_derivative(radial(V(x * x + y * y)), x, y, d11, d12, d22);
        const V fx_z = this->fx * inv_z, fy_z = this->fy * inv_z;
        at.j1[0] = fx_z * d11;
        at.j1[1] = fx_z * d12;
        at.j1[2] = -fx_z * (d11 * x + d12 * y);
        at.j2[0] = fy_z * d12;
        at.j2[1] = fy_z * d22;
        at.j2[2] = -fy_z * (d12 * x + d22 * y);
    }

    // Computes the gradients of the slopes in the Jacobian from those of its rows.
    template <class V>
    V3DG_HD V3DG_INLINE void jacobian_vjp(const V& inv_z, const V& x, const V& y, const V d_j1[3],
                                          const V d_j2[3], V& d_x, V& d_y) const {
        const RadialFactor<V> factor = radial(V(x * x + y * y));
        V d11, d12, d22;
        set_derivative(factor, x, y, d11, d12, d22);
        const V fx_z = this->fx * inv_z, fy_z = this->fy * inv_z;
        const V d_d11 = fx_z * (d_j1[0] - x * d_j1[2]);
        const V d_d12 = fx_z * (d_j1[1] - y * d_j1[2]) + fy_z * (d_j2[0] - x * d_j2[2]);
        const V d_d22 = fy_z * (d_j2[1] - y * d_j2[2]);
        const V slope = factor.slope, four = 4 * factor.curvature;
        const V d11_x = x * (6 * slope + four * x * x) + 6 * p2;
        const V d11_y = y * (2 * slope + four * x * x) + 2 * p1;
        const V d22_x = x * (2 * slope + four * y * y) + 2 * p2;
        const V d22_y = y * (6 * slope + four * y * y) + 6 * p1;
        d_x = d_d11 * d11_x + d_d12 * d11_y + d_d22 * d22_x -
              (fx_z * d11 * d_j1[2] + fy_z * d12 * d_j2[2]);
        d_y = d_d11 * d11_y + d_d12 * d22_x + d_d22 * d22_y -
              (fx_z * d12 * d_j1[2] + fy_z * d22 * d_j2[2]);
    }
};

}  // namespace v3dg
