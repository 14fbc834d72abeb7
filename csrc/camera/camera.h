#pragma once

// The interface of camera models. A camera model maps points in view space to pixels.
// Code outside of this folder uses a model only through the concept CameraModel, by the
// name Intrinsics<T>. The pose of a camera does not depend on the model (math/view.h).
//
// To add a camera model:
// 1. Write camera/<model>.h beside pinhole.h: a trivially copyable struct template over
//    the scalar type, with the members below. Mark the members V3DG_HD and V3DG_INLINE,
//    because kernels and loops that are compiled per instruction set call them. Where
//    the list says V, a member also takes vectors.
// 2. Check the model with a static_assert, as for Pinhole below.
//    tests/cpp/second_camera.cpp shows a small second model that projects gaussians.
// 3. Add the model to LensModel and to Intrinsics<T>, the only place that chooses a
//    model. Code that projects many gaussians chooses once, by visit() on the host and
//    by a template argument of a kernel, so that pinholes do not pay for other models.
//    Distorted models share camera/distorted.h.
// 4. Let users create the model: extend bindings/bind_types.cpp, v3dg/cameras.py and,
//    if camera files can name the model, v3dg/camera_file.py. The code in fit_group/
//    and levels/ draws its own pictures with pinholes and needs no change.
// 5. Reject Footprint::paper for the model: it is defined only for pinholes
//    (select/footprint.h).
//
// The members of a model follow. T is the scalar type of the model; V is T or a vector
// of T.
//
// Types and constants
// - Scalar: the type T.
// - Limits: values that linearized() needs and that are computed once per image.
// - Point<V>: the values that determine the Jacobian at a point.
// - Sides: the side planes of a frustum, in camera coordinates.
// - kNumPlanes: the number of planes that bound the visible volume.
//
// Members
// - width, height: size of the image, px.
// - near_depth: depth of the near plane; positive. Nothing nearer is drawn.
// - rounded_to<U>(): the same camera with scalar type U.
// - scale(factor): multiplies the resolution by `factor`.
// - crop(left, top, width, height): replaces the image by a rectangle of the image, px.
//   The rectangle may extend beyond the image.
//
// Projection
// - depth_of(p): the depth of a point in view space. Gaussians are sorted by depth. A
//   point is drawn if its depth is at least near_depth. It is negative for points that
//   the model does not show.
// - limits(): computes the Limits of an image.
// - linearized(limits, p): the Jacobian of the projection at p.
// - to_pixel(at, p, u, v): the pixel (u, v) of p.
// - times_jacobian(at, x, y, z, a1, a2): the product of the Jacobian and one column (x,
//   y, z) of a 3x3 matrix, of type V or T.
// - linearized_vjp(at, p, m, a1, a2, d, d_p, d_m): the gradients of p and of the
//   row-major matrix m. Its input d holds the gradients of the pixel, of the depth, and
//   of the rows a1 and a2 of the Jacobian times m.
//
// Bounds. Kernels skip work by these. They may be too large, but never too small.
// - sphere_scale(limits, squared_model_scale): a factor for image_of_sphere(). The
//   scale from model space to view space is the root of squared_model_scale. NaN if the
//   model has no bound for these limits.
// - image_of_sphere(p, radius, sphere_scale, filter_px2): the image of a sphere around
//   p; the radius is in model space. `half` is at least the half extent, in x and in y,
//   of a gaussian inside the sphere after a screen-space filter of variance filter_px2.
//
// Selection
// - px2_per_steradian(): pixels per solid angle, one number per camera; selection
//   computes footprints with it. Any positive number gives an exact cut. A model with
//   uneven density returns its maximum over all directions, so that the cut is fine
//   enough everywhere.
// - sides_of(eyes, num_eyes, pad_px): the side planes around everything that any of the
//   eyes sees, moved outwards by pad_px from the requested part of the image. An eye is
//   a Camera.
// - front_offset(axes, inverse_scale): Plane::offset of the near plane in the frame of
//   an instance with this inverse scale.
// - set_planes(sides, first, second, front_offset, plane): the kNumPlanes planes in the
//   frame of an instance. `first` and `second` are the axes of the two eyes, which are
//   equal if there is one eye. A gaussian outside of any plane is not drawn.
//   Plane::guard accounts for the linearisation; with INFINITY, a plane culls nothing.
// - set_guard_direction(axes, direction): the direction of Plane::guard in the frame of
//   an instance.

#include <concepts>
#include <cstdint>
#include <cstring>
#include <type_traits>

#include "camera/fisheye.h"
#include "camera/image_terms.h"
#include "camera/opencv.h"
#include "camera/pinhole.h"
#include "math/similarity.h"
#include "math/view.h"

namespace v3dg {

// The models that a camera can have.
enum class LensModel { pinhole, opencv, fisheye };

// A camera of any model. It has the fields of a pinhole camera, and the parameters of
// its lens, which only the model reads. Its members call those of the model. Loops over
// gaussians call visit() outside the loop, so that pinhole cameras do not pay for the
// choice.
template <class T>
struct Intrinsics : Pinhole<T> {
    using Limits = SlopeLimits<T>;
    template <class V>
    using Point = ImagePoint<V>;
    static constexpr int kNumLensValues = 10;

    // The LensModel, in a type as large as T, so that there is no padding.
    std::conditional_t<sizeof(T) == sizeof(int64_t), int64_t, int32_t> lens;
    T lens_values[kNumLensValues];

    V3DG_HD V3DG_INLINE LensModel model() const { return static_cast<LensModel>(lens); }
    V3DG_HD V3DG_INLINE bool is_pinhole() const { return model() == LensModel::pinhole; }
    V3DG_HD V3DG_INLINE const Pinhole<T>& pinhole() const { return *this; }
    V3DG_HD V3DG_INLINE OpenCv<T> opencv() const {
        const T* v = lens_values;
        return {{pinhole()}, {v[0], v[1], v[2], v[3], v[4], v[5]}, v[6], v[7], v[8], v[9]};
    }
    V3DG_HD V3DG_INLINE Fisheye<T> fisheye() const {
        const T* v = lens_values;
        return {{pinhole()}, {v[0], v[1], v[2], v[3]}, v[4], v[5], v[6], v[7], v[8]};
    }
    // Calls body(model) and returns its result.
    template <class Body>
    V3DG_HD V3DG_INLINE auto visit(const Body& body) const {
        switch (model()) {
            case LensModel::opencv: return body(opencv());
            case LensModel::fisheye: return body(fisheye());
            default: return body(pinhole());
        }
    }

    template <class U>
    V3DG_HD Intrinsics<U> rounded_to() const {
        Intrinsics<U> out{pinhole().template rounded_to<U>(), {}, {}};
        out.lens = static_cast<decltype(out.lens)>(lens);
        for (int i = 0; i < kNumLensValues; ++i) out.lens_values[i] = U(lens_values[i]);
        return out;
    }
    template <class V>
    V3DG_HD V3DG_INLINE V depth_of(const V p[3]) const {
        switch (model()) {
            case LensModel::opencv: return opencv().depth_of(p);
            case LensModel::fisheye: return fisheye().depth_of(p);
            default: return pinhole().depth_of(p);
        }
    }
    V3DG_HD V3DG_INLINE SlopeLimits<T> limits() const { return pinhole().limits(); }
    template <class V>
    V3DG_HD V3DG_INLINE ImagePoint<V> linearized(const SlopeLimits<T>& limits, const V p[3]) const {
        switch (model()) {
            case LensModel::opencv: return opencv().linearized(limits, p);
            case LensModel::fisheye: return fisheye().linearized(limits, p);
            default: break;
        }
        const PinholePoint<V> at = pinhole().linearized(limits, p);
        const V fx_z = this->fx * at.inv_z, fy_z = this->fy * at.inv_z;
        ImagePoint<V> out{{}, {}, {fx_z, {}, -fx_z * at.slope_x}, {{}, fy_z, -fy_z * at.slope_y}};
        pinhole().to_pixel(at, p, out.u, out.v);
        return out;
    }
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
    template <class V>
    V3DG_HD V3DG_INLINE void linearized_vjp(const ImagePoint<V>& at, const V p[3], const V m[9],
                                            const V a1[3], const V a2[3], const LinearImage<V>& d,
                                            V d_p[3], V d_m[9]) const {
        switch (model()) {
            case LensModel::opencv: return opencv().linearized_vjp(at, p, m, a1, a2, d, d_p, d_m);
            case LensModel::fisheye: return fisheye().linearized_vjp(at, p, m, a1, a2, d, d_p, d_m);
            default: break;
        }
        pinhole().linearized_vjp(pinhole().linearized(limits(), p), p, m, a1, a2, d, d_p, d_m);
    }
    V3DG_HD V3DG_INLINE T sphere_scale(const SlopeLimits<T>& limits, T squared_model_scale) const {
        return is_pinhole() ? pinhole().sphere_scale(limits, squared_model_scale) : T(NAN);
    }
    V3DG_HD T px2_per_steradian() const {
        switch (model()) {
            case LensModel::opencv: return opencv().px2_per_steradian();
            case LensModel::fisheye: return fisheye().px2_per_steradian();
            default: return pinhole().px2_per_steradian();
        }
    }
    template <class Eye>
    static V3DG_HD FrustumSides sides_of(const Eye eyes[2], int num_eyes, double pad_px) {
        switch (eyes[0].model()) {
            case LensModel::opencv: return OpenCv<T>::sides_of(eyes, num_eyes, pad_px);
            case LensModel::fisheye: return Fisheye<T>::sides_of(eyes, num_eyes, pad_px);
            default: return Pinhole<T>::sides_of(eyes, num_eyes, pad_px);
        }
    }
    V3DG_HD double front_offset(const InstanceAxes& in, double inverse_scale) const {
        if (model() == LensModel::fisheye) return fisheye().front_offset(in, inverse_scale);
        return pinhole().front_offset(in, inverse_scale);
    }
    V3DG_HD void set_guard_direction(const InstanceAxes& in, float direction[3]) const {
        if (is_pinhole())
            Pinhole<T>::set_guard_direction(in, direction);
        else
            Distorted<T>::set_guard_direction(in, direction);
    }
};

// Return the projection of each model. `values` has the coefficients in the order of
// the model's fields. These functions also compute the valid ranges of the model.
template <class T>
V3DG_HD Intrinsics<T> intrinsics_of(const Pinhole<T>& projection) {
    return {projection, 0, {}};
}
inline Intrinsics<double> intrinsics_of_opencv(const Pinhole<double>& projection,
                                               const double values[8]) {
    OpenCv<double> lens{{projection}, {}, values[6], values[7], 0, 0};
    for (int i = 0; i < 6; ++i) lens.k[i] = values[i];
    lens.set_ranges();
    Intrinsics<double> out{projection, static_cast<int64_t>(LensModel::opencv), {}};
    for (int i = 0; i < 8; ++i) out.lens_values[i] = values[i];
    out.lens_values[8] = lens.clamp_slope;
    out.lens_values[9] = lens.valid_slope;
    return out;
}
inline Intrinsics<double> intrinsics_of_fisheye(const Pinhole<double>& projection,
                                                const double values[4]) {
    Fisheye<double> lens{{projection}, {}, 0, 0, 0, 0, 0};
    for (int i = 0; i < 4; ++i) lens.k[i] = values[i];
    lens.set_ranges();
    const double ranges[5] = {lens.clamp_angle, lens.clamp_sin, lens.clamp_cos, lens.valid_angle,
                              lens.valid_cos};
    Intrinsics<double> out{projection, static_cast<int64_t>(LensModel::fisheye), {}};
    for (int i = 0; i < 4; ++i) out.lens_values[i] = values[i];
    for (int i = 0; i < 5; ++i) out.lens_values[4 + i] = ranges[i];
    return out;
}

// A camera in the world, in double precision: its pose, its camera model, and the part
// of its image that is drawn.
struct Camera : CameraPose, Intrinsics<double>, ImagePart {
    // The result of px2_per_steradian(), stored because selection needs it for each
    // instance. Not used for pinhole cameras.
    double density;

    // Returns the camera model with scalar type T.
    template <class T>
    V3DG_HD Intrinsics<T> intrinsics() const {
        return rounded_to<T>();
    }
    V3DG_HD double px2_per_steradian() const {
        return is_pinhole() ? pinhole().px2_per_steradian() : density;
    }
    // Sets the camera model. The pose and the part of the image that is drawn stay the
    // same.
    void set_lens(const Intrinsics<double>& projection) {
        static_cast<Intrinsics<double>&>(*this) = projection;
        density = projection.px2_per_steradian();
    }
    // Returns this camera with `factor` times the resolution.
    V3DG_HD Camera scaled(double factor) const {
        Camera camera = *this;
        camera.scale(factor);
        camera.x0 *= factor;
        camera.y0 *= factor;
        camera.x1 *= factor;
        camera.y1 *= factor;
        camera.density *= factor * factor;
        return camera;
    }
    // Returns a camera whose image is a rectangle of this camera's image. The rectangle
    // is given in px.
    V3DG_HD Camera cropped(double left, double top, double new_width, double new_height) const {
        Camera camera = *this;
        camera.crop(left, top, new_width, new_height);
        camera.x0 = 0;
        camera.y0 = 0;
        camera.x1 = new_width;
        camera.y1 = new_height;
        return camera;
    }
};
static_assert(sizeof(Camera) == 38 * sizeof(double),
              "operator== compares all bytes, so Camera must have no padding");

// Returns a camera with the given projection, which draws its whole image. The caller
// must set the pose.
inline Camera with_projection(const Intrinsics<double>& projection) {
    return {CameraPose{}, projection, ImagePart{0, 0, projection.width, projection.height},
            projection.px2_per_steradian()};
}

// The viewpoint for which a cut is selected. It is one camera, or the two eyes of a
// stereo camera, which have the same rotation.
struct Eyes {
    Camera camera[2];  // if there is one eye, both elements are equal
    bool are_two;

    Eyes() : Eyes(Camera{}) {}
    V3DG_HD Eyes(const Camera& only) : camera{only, only}, are_two(false) {}
    V3DG_HD Eyes(const Camera& left, const Camera& right) : camera{left, right}, are_two(true) {}
    V3DG_HD int count() const { return are_two ? 2 : 1; }
    // Compares bits, so that NaN equals itself, and -0 differs from 0.
    bool operator==(const Eyes& other) const {
        return are_two == other.are_two && std::memcmp(camera, other.camera, sizeof camera) == 0;
    }
};

// The members of CameraModel that projection uses.
template <class C>
concept ProjectingModel =
    std::is_trivially_copyable_v<C> &&
    requires(const C& camera, const typename C::Limits& limits,
             const typename C::template Point<typename C::Scalar>& at,
             const typename C::Scalar* numbers, typename C::Scalar number,
             typename C::Scalar* results, typename C::Scalar& result,
             const LinearImage<typename C::Scalar>& gradients) {
        { camera.width } -> std::convertible_to<typename C::Scalar>;
        { camera.height } -> std::convertible_to<typename C::Scalar>;
        { camera.near_depth } -> std::convertible_to<typename C::Scalar>;
        camera.template rounded_to<float>();
        requires requires(C changed, typename C::Scalar px) {
            changed.scale(px);
            changed.crop(px, px, px, px);
        };
        { camera.depth_of(numbers) } -> std::same_as<typename C::Scalar>;
        { camera.limits() } -> std::same_as<typename C::Limits>;
        {
            camera.linearized(limits, numbers)
        } -> std::same_as<typename C::template Point<typename C::Scalar>>;
        camera.to_pixel(at, numbers, result, result);
        camera.times_jacobian(at, number, number, number, result, result);
        camera.linearized_vjp(at, numbers, numbers, numbers, numbers, gradients, results, results);
        { camera.sphere_scale(limits, number) } -> std::same_as<typename C::Scalar>;
        {
            camera.image_of_sphere(numbers, number, number, number)
        } -> std::same_as<SphereImage<typename C::Scalar>>;
    };

// The members of CameraModel that selection uses.
template <class C>
concept SelectingModel =
    requires(const C& camera, const Camera* eyes, const typename C::Sides& sides,
             const InstanceAxes& axes, double number, Plane* planes) {
        { camera.px2_per_steradian() } -> std::same_as<typename C::Scalar>;
        { C::sides_of(eyes, 2, number) } -> std::same_as<typename C::Sides>;
        { camera.front_offset(axes, number) } -> std::same_as<double>;
        C::set_planes(sides, axes, axes, number, planes);
        camera.set_guard_direction(axes, &planes->guard);
        requires C::kNumPlanes > 0;
    };

template <class C>
concept CameraModel = ProjectingModel<C> && SelectingModel<C>;

static_assert(CameraModel<Pinhole<float>> && CameraModel<Pinhole<double>>);
static_assert(CameraModel<OpenCv<float>> && CameraModel<OpenCv<double>>);
static_assert(CameraModel<Fisheye<float>> && CameraModel<Fisheye<double>>);
static_assert(CameraModel<Intrinsics<float>> && CameraModel<Intrinsics<double>>);

}  // namespace v3dg
