#pragma once

// The pinhole camera model. A point (x, y, z) in view space has the depth z, and is
// drawn at pixel (fx x / z + cx, fy y / z + cy). camera/camera.h explains the members.
//
// The Jacobian of the projection is
//   J = [fx / z, 0, -fx / z sx; 0, fy / z, -fy / z sy]   with sx = x / z, sy = y / z.
// Outside the image, the slopes sx and sy in J are clamped, because the linearised
// image of a gaussian would become far too large (as in 3D Gaussian Splatting).

#include <cmath>

#include "camera/image_terms.h"
#include "math/gaussian.h"
#include "math/lanes.h"
#include "math/similarity.h"
#include "math/vec.h"

namespace v3dg {

// The distance from the edge of the image to the clamped slopes, in units of half the
// field of view.
constexpr double kFovMargin = 0.3;

// The range to which the slopes x / z and y / z in the Jacobian are clamped.
template <class T>
struct SlopeLimits {
    T low_x, high_x, low_y, high_y;
};

// The values that determine the Jacobian at a point.
template <class V>
struct PinholePoint {
    V inv_z;
    V slope_x, slope_y;  // x / z and y / z, clamped
};

// The side planes of a frustum in camera coordinates: right, left, bottom, top. A point
// is outside a plane if sign * x > slope * z, or if sign * y > slope * z for bottom and
// top. With two eyes, each plane has the larger slope of the two, so that a point
// outside the plane for both eyes is outside both frusta.
struct FrustumSides {
    double slope[4];
    float guard[4];  // explained at Plane::guard
};

// A pinhole camera, in px. The centre of pixel (i, j) is at (i + ½, j + ½).
template <class T>
struct Pinhole {
    using Scalar = T;
    using Limits = SlopeLimits<T>;
    using Sides = FrustumSides;
    template <class V>
    using Point = PinholePoint<V>;
    static constexpr int kNumPlanes = 5;

    T fx, fy, cx, cy;
    T width, height;
    T near_depth;

    template <class U>
    V3DG_HD Pinhole<U> rounded_to() const {
        return {.fx = U(fx),
                .fy = U(fy),
                .cx = U(cx),
                .cy = U(cy),
                .width = U(width),
                .height = U(height),
                .near_depth = U(near_depth)};
    }

    V3DG_HD void scale(T factor) {
        fx *= factor;
        fy *= factor;
        cx *= factor;
        cy *= factor;
        width *= factor;
        height *= factor;
    }

    V3DG_HD void crop(T left, T top, T new_width, T new_height) {
        cx -= left;
        cy -= top;
        width = new_width;
        height = new_height;
    }

    template <class V>
    V3DG_HD V3DG_INLINE V depth_of(const V p[3]) const {
        return p[2];
    }

    V3DG_HD V3DG_INLINE SlopeLimits<T> limits() const {
        const T margin_x = T(kFovMargin) * width / (2 * fx);
        const T margin_y = T(kFovMargin) * height / (2 * fy);
        return {.low_x = -(cx / fx + margin_x),
                .high_x = (width - cx) / fx + margin_x,
                .low_y = -(cy / fy + margin_y),
                .high_y = (height - cy) / fy + margin_y};
    }

    template <class V>
    V3DG_HD V3DG_INLINE PinholePoint<V> linearized(const SlopeLimits<T>& limits,
                                                   const V p[3]) const {
        const V inv_z = 1 / p[2];
        return {.inv_z = inv_z,
                .slope_x = cut_to(limits.low_x, limits.high_x, p[0] * inv_z),
                .slope_y = cut_to(limits.low_y, limits.high_y, p[1] * inv_z)};
    }

    template <class V>
    V3DG_HD V3DG_INLINE void to_pixel(const PinholePoint<V>& at, const V p[3], V& u, V& v) const {
        u = fx * p[0] * at.inv_z + cx;
        v = fy * p[1] * at.inv_z + cy;
    }

    template <class V, class W>
    V3DG_HD V3DG_INLINE void times_jacobian(const PinholePoint<V>& at, const W& x, const W& y,
                                            const W& z, V& a1, V& a2) const {
        a1 = fx * at.inv_z * (x - at.slope_x * z);
        a2 = fy * at.inv_z * (y - at.slope_y * z);
    }

    template <class V>
    V3DG_HD V3DG_INLINE void linearized_vjp(const PinholePoint<V>& at, const V p[3], const V m[9],
                                            const V a1[3], const V a2[3], const LinearImage<V>& d,
                                            V d_p[3], V d_m[9]) const {
        const V fx_z = fx * at.inv_z, fy_z = fy * at.inv_z;
        for (int k = 0; k < 3; ++k) {
            d_m[k] = fx_z * d.a1[k];
            d_m[3 + k] = fy_z * d.a2[k];
            d_m[6 + k] = -at.slope_x * d_m[k] - at.slope_y * d_m[3 + k];
        }
        // If a slope is clamped, the Jacobian is constant in that slope.
        const V true_x = p[0] * at.inv_z, true_y = p[1] * at.inv_z;
        V d_slope_x = -(d_m[0] * m[6] + d_m[1] * m[7] + d_m[2] * m[8]);
        V d_slope_y = -(d_m[3] * m[6] + d_m[4] * m[7] + d_m[5] * m[8]);
        d_slope_x = (true_x == at.slope_x ? d_slope_x : V{}) + d.u * fx;
        d_slope_y = (true_y == at.slope_y ? d_slope_y : V{}) + d.v * fy;
        d_p[0] = d_slope_x * at.inv_z;
        d_p[1] = d_slope_y * at.inv_z;
        d_p[2] = d.depth - at.inv_z * (dot3(a1, d.a1) + dot3(a2, d.a2) + true_x * d_slope_x +
                                       true_y * d_slope_y);
    }

    V3DG_HD V3DG_INLINE T sphere_scale(const SlopeLimits<T>& limits, T squared_model_scale) const {
        if (!sees_its_axis(limits)) return T(NAN);
        const T model_scale = sqrt_of(squared_model_scale);
        return max_of(fx, fy) * model_scale;
    }

    V3DG_HD V3DG_INLINE SphereImage<T> image_of_sphere(const T p[3], T radius, T sphere_scale,
                                                       const T& filter_px2) const {
        const T inv_z = 1 / p[2], slope_x = p[0] * inv_z, slope_y = p[1] * inv_z;
        const T u = fx * slope_x + cx, v = fy * slope_y + cy;
        const T half = half_of_sphere(sphere_scale * radius, inv_z, slope_x, slope_y, filter_px2);
        return {.u = u, .v = v, .half = half};
    }

    // Returns the density at the optical axis. The true density grows away from the
    // axis. This growth is ignored, so that the cut does not depend on the camera's
    // rotation.
    V3DG_HD T px2_per_steradian() const { return fx * fy; }

    template <class Eye>
    static V3DG_HD FrustumSides sides_of(const Eye eyes[2], int num_eyes, double pad_px) {
        FrustumSides sides;
        for (int side = 0; side < 4; ++side) {
            const bool is_x = side < 2, is_positive = side % 2 == 0;
            double linearised[2];  // slope up to which the Jacobian is exact
            for (int k = 0; k < num_eyes; ++k) {
                const Eye& eye = eyes[k];
                const double focal = is_x ? eye.fx : eye.fy;
                const double size = is_x ? eye.width : eye.height;
                const double middle = is_x ? eye.cx : eye.cy;
                const double edge_px = is_positive ? size - middle : middle;
                const double wanted_px = is_positive ? (is_x ? eye.x1 : eye.y1) - middle
                                                     : middle - (is_x ? eye.x0 : eye.y0);
                linearised[k] = (edge_px + kFovMargin * size / 2) / focal;
                const double slope = (wanted_px + pad_px) / focal;
                sides.slope[side] = k == 0 ? slope : max_of(sides.slope[side], slope);
            }
            double guard = fabs(linearised[0] - sides.slope[side]);
            if (num_eyes > 1) guard = max_of(guard, fabs(linearised[1] - sides.slope[side]));
            sides.guard[side] = static_cast<float>(guard);
        }
        return sides;
    }

    V3DG_HD double front_offset(const InstanceAxes& in, double inverse_scale) const {
        return near_depth * inverse_scale - in.origin[2];
    }

    static V3DG_HD void set_guard_direction(const InstanceAxes& in, float direction[3]) {
        for (int k = 0; k < 3; ++k) direction[k] = static_cast<float>(in.axes[6 + k]);
    }

    static V3DG_HD void set_planes(const FrustumSides& sides, const InstanceAxes& first,
                                   const InstanceAxes& second, double front_offset,
                                   Plane plane[kNumPlanes]) {
        // A point is outside the near plane if its depth is less than near_depth.
        Plane& front = plane[0];
        for (int k = 0; k < 3; ++k) front.normal[k] = static_cast<float>(-first.axes[6 + k]);
        front.offset = static_cast<float>(front_offset);
        front.guard = 0.0f;
        for (int side = 0; side < 4; ++side) {
            const double sign = side % 2 == 0 ? 1.0 : -1.0, slope = sides.slope[side];
            const double* axis = first.axes + (side < 2 ? 0 : 3);
            Plane& out = plane[1 + side];
            for (int k = 0; k < 3; ++k)
                out.normal[k] = static_cast<float>(sign * axis[k] - slope * first.axes[6 + k]);
            const int across = side < 2 ? 0 : 1;
            out.offset =
                static_cast<float>(min_of(sign * first.origin[across] - slope * first.origin[2],
                                          sign * second.origin[across] - slope * second.origin[2]));
            out.guard = sides.guard[side];
        }
    }

  private:
    // Returns whether the optical axis is inside the clamped range. If it is, clamping
    // moves slopes towards the axis, as half_of_sphere() assumes.
    static V3DG_HD V3DG_INLINE bool sees_its_axis(const SlopeLimits<T>& limits) {
        return limits.low_x < 0 && limits.high_x > 0 && limits.low_y < 0 && limits.high_y > 0;
    }

    // Returns the half extent for image_of_sphere(). `reach_px` is the radius of the
    // sphere's image at depth 1.
    static V3DG_HD V3DG_INLINE T half_of_sphere(T reach_px, T inv_z, T slope_x, T slope_y,
                                                const T& filter_px2) {
        const T along = reach_px * inv_z;
        return sqrt_of(along * along * (1 + slope_x * slope_x + slope_y * slope_y) +
                       T(kReachSigmas * kReachSigmas) * filter_px2);
    }
};

}  // namespace v3dg
