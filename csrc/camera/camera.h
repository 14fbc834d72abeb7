#pragma once

// The interface of camera models. A model maps view space to the image. All code
// outside of this folder uses it through the concept CameraModel, and names the type in
// use Intrinsics<T>. The poses of cameras do not depend on the model (math/view.h).
//
// Add a camera model:
// 1. Write camera/<model>.h beside pinhole.h: a struct template over the scalar type,
//    trivially copyable, with the members below. Kernels and loops that are compiled
//    per instruction set call them, so they are V3DG_HD and V3DG_INLINE, and take
//    vectors where CameraModel says V.
// 2. Check it with a static_assert, as Pinhole is checked below.
//    tests/cpp/second_camera.cpp projects gaussians with a small second model.
// 3. Add it to Intrinsics<T>, the only dispatch. With a single model that is an alias.
//    With several it becomes a struct with a tag and one of the models, whose members
//    call those of the model. The struct itself satisfies CameraModel, so kernels do
//    not change.
// 4. Let users make one: bindings/bind_types.cpp, v3dg/cameras.py, and
//    v3dg/camera_file.py if files name it. fit_group/ and levels/ make cameras of
//    their own, which are pinholes and continue to be so.
// 5. Footprint::paper is defined only for pinholes (select/footprint.h); reject it for
//    other models.
//
// The members of a model, where T is its scalar type, and V is T or a vector of T:
//
// Types and constants
// - Scalar: T. Limits: values that linearized() needs and that are computed once per
//   image. Point<V>: the values that the Jacobian at a point depends on. Sides: the
//   planes of a frustum in camera coordinates. kNumPlanes: the number of planes that
//   bound what the camera sees.
//
// Members
// - width, height: size of the image, px. near_depth: nothing nearer is drawn;
//   positive.
// - rounded_to<U>(): the same camera with another scalar type.
// - scale(factor): multiplies the resolution.
// - crop(left, top, width, height): makes this rectangle of the image, px, the whole
//   image. It may extend beyond the old one.
//
// Projection
// - depth_of(p): the depth of a point in view space, by which gaussians are sorted. A
//   point is drawn if its depth is at least near_depth.
// - limits(): see Limits.
// - linearized(limits, p): the Jacobian of the projection at p.
// - to_pixel(at, p, u, v): the image of p.
// - times_jacobian(at, x, y, z, a1, a2): a column (x, y, z) of a 3x3 matrix times the
//   Jacobian, of type V or T.
// - linearized_vjp(at, p, m, a1, a2, d, d_p, d_m): the gradients of p and of the
//   row-major matrix m from those of the pixel, the depth and the rows a1, a2 of the
//   Jacobian times m.
//
// Bounds, by which kernels skip work. They may be too large, but never too small.
// - sphere_scale(limits, squared_model_scale): a factor for image_of_sphere(), for
//   models that are scaled by model_scale in view space; NaN if that function gives no
//   bound.
// - image_of_sphere(p, radius, sphere_scale, filter_px2): the image of a sphere around
//   p, whose radius is in the units of the model. `half` is at least the half extent,
//   in x and in y, of a gaussian with that reach from p and a screen-space filter of
//   variance filter_px2.
//
// Selection
// - px2_per_steradian(): the density of pixels that footprints use, one number per
//   camera. Any positive number gives an exact cut. A model with uneven density returns
//   an upper bound over all directions, which is also a bound over any ball; then the
//   cut is fine enough everywhere.
// - sides_of(eyes, num_eyes, pad_px): planes around what any of the eyes sees, pad_px
//   outside of the requested part of the image. An eye is a Camera.
// - front_offset(axes, inverse_scale): the offset of the near plane, or of its
//   equivalent, for an instance of this inverse scale.
// - set_planes(sides, first, second, front_offset, plane): the kNumPlanes planes in the
//   frame of an instance, from the axes of both eyes, which are equal if there is one
//   eye. What lies outside of any plane is not drawn. Plane::guard compensates for the
//   linearisation; INFINITY culls nothing.

#include <concepts>
#include <cstring>
#include <type_traits>

#include "camera/image_terms.h"
#include "camera/pinhole.h"
#include "math/similarity.h"
#include "math/view.h"

namespace v3dg {

// The model in use: the part of a camera that maps view space to the image.
template <class T>
using Intrinsics = Pinhole<T>;

// A camera in the world, in double precision: its pose, its projection, and the
// requested part of its image.
struct Camera : CameraPose, Intrinsics<double>, ImagePart {
    // Returns the projection with the scalar type of a computation.
    template <class T>
    V3DG_HD Intrinsics<T> intrinsics() const {
        return rounded_to<T>();
    }
    // Returns the same view with `factor` times the resolution.
    V3DG_HD Camera scaled(double factor) const {
        Camera camera = *this;
        camera.scale(factor);
        camera.x0 *= factor;
        camera.y0 *= factor;
        camera.x1 *= factor;
        camera.y1 *= factor;
        return camera;
    }
    // Returns a camera whose whole image is this rectangle of the image, px.
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
static_assert(sizeof(Camera) == 26 * sizeof(double), "nothing but its numbers is compared");

// Returns a camera with this projection, whose whole image is requested. The caller
// sets its pose.
inline Camera with_projection(const Intrinsics<double>& projection) {
    return {CameraPose{}, projection, ImagePart{0, 0, projection.width, projection.height}};
}

// The viewpoint of one cut: a camera, or the two eyes of a stereo camera, whose
// rotations are equal.
struct Eyes {
    Camera camera[2];  // both are equal if there is one eye
    bool are_two;

    Eyes() : Eyes(Camera{}) {}
    V3DG_HD Eyes(const Camera& only) : camera{only, only}, are_two(false) {}
    V3DG_HD Eyes(const Camera& left, const Camera& right) : camera{left, right}, are_two(true) {}
    V3DG_HD int count() const { return are_two ? 2 : 1; }
    // Compares bits.
    bool operator==(const Eyes& other) const {
        return are_two == other.are_two && std::memcmp(camera, other.camera, sizeof camera) == 0;
    }
};

// The requirements of projection on a model.
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

// The requirements of selection on a model.
template <class C>
concept SelectingModel =
    requires(const C& camera, const Camera* eyes, const typename C::Sides& sides,
             const InstanceAxes& axes, double number, Plane* planes) {
        { camera.px2_per_steradian() } -> std::same_as<typename C::Scalar>;
        { C::sides_of(eyes, 2, number) } -> std::same_as<typename C::Sides>;
        { camera.front_offset(axes, number) } -> std::same_as<double>;
        C::set_planes(sides, axes, axes, number, planes);
        requires C::kNumPlanes > 0;
    };

template <class C>
concept CameraModel = ProjectingModel<C> && SelectingModel<C>;

static_assert(CameraModel<Pinhole<float>> && CameraModel<Pinhole<double>>);
static_assert(CameraModel<Intrinsics<float>> && CameraModel<Intrinsics<double>>);

}  // namespace v3dg
