#pragma once

// The seam for camera models. A model knows how points of view space come onto the
// image; all of the code but this folder asks it through the concept CameraModel, and
// names the type that is in use as Intrinsics<T>. The poses of cameras do not depend on
// the model (math/view.h).
//
// Add a camera model:
// 1. Write camera/<model>.h beside pinhole.h: a struct template over the scalar,
//    trivially copyable, with the members that CameraModel lists below. They are called
//    from kernels and from loops that are compiled per instruction set, so they are
//    V3DG_HD and V3DG_INLINE and take vectors where CameraModel says V.
// 2. Check it with a static_assert, as Pinhole is checked below;
//    tests/cpp/second_camera.cpp shows a small model that goes through projection.
// 3. Give it its place in Intrinsics<T>, the one dispatch. With a single model that is
//    an alias. With several it becomes a struct that holds one of them and a tag, and
//    whose members ask the one that it holds; it models CameraModel itself, so kernels
//    stay as they are.
// 4. Let users make one: bindings/bind_types.cpp and v3dg/cameras.py. fit_group/ makes
//    pictures of its own with pinholes and goes on doing so. levels/cut_views.cpp,
//    levels/first_selected.cpp and levels/refine_cuts_math.h set and scale the numbers
//    of pinholes, and have to refuse others.
// 5. Footprint::paper is defined for pinholes alone (select/footprint.h); refuse it for
//    others.
//
// What a model supplies, with T its scalar and V a T or a vector of them:
//
// Types and constants
// - Scalar: T. Limits: what linearized() needs that is computed once an image.
//   Point<V>: what the Jacobian at a point depends on. Sides: the planes of a frustum
//   in camera coordinates. kNumPlanes: how many planes bound what it sees.
//
// Members
// - width, height: size of the image, px. near_depth: nothing nearer is drawn;
//   positive.
// - rounded_to<U>(): the same camera with another scalar.
//
// Projection
// - depth_of(p): the depth of a point in view space, by which gaussians are sorted. A
//   point is drawn where it is at least near_depth.
// - limits(): see Limits.
// - linearized(limits, p): the Jacobian of the projection at p.
// - to_pixel(at, p, u, v): the image of p.
// - times_jacobian(at, x, y, z, a1, a2): a column (x, y, z) of a 3x3 matrix times the
//   Jacobian, of type V or T.
// - linearized_vjp(at, p, m, a1, a2, d, d_p, d_m): the gradients of p and of the
//   row-major matrix m from those of the pixel, the depth and the rows a1, a2 of the
//   Jacobian times m.
//
// Bounds, which let kernels skip work and never decide what is drawn
// - sphere_scale(limits, squared_model_scale): a factor that image_of_sphere() takes,
//   for models that are scaled by model_scale in view space; NaN where that function
//   bounds nothing.
// - image_of_sphere(p, radius, sphere_scale, filter_px2): the image of a sphere around
//   p, whose radius is in the units of the model. `half` is no less than either half
//   extent of a gaussian that reaches that far from p, with a screen-space filter of
//   variance filter_px2.
//
// Selection
// - px2_per_steradian(): the density that footprints are measured with, one number a
//   camera. Any positive number gives an exact cut. A model of uneven density returns
//   an upper bound over all directions, which then bounds it over any ball, too.
// - sides_of(eyes, num_eyes, pad_px): planes, pad_px outside of the part of the image
//   that is wanted, that hold what any of the eyes sees. An eye is a Camera.
// - front_offset(axes, inverse_scale): the offset of the near plane, or of what stands
//   for it, for an instance of this inverse scale.
// - set_planes(sides, first, second, front_offset, plane): the kNumPlanes planes in the
//   frame of an instance, from the axes of both eyes, which are the same where there is
//   one. What lies outside of one of them is not drawn. Plane::guard makes up for the
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
};
static_assert(sizeof(Camera) == 26 * sizeof(double), "nothing but its numbers is compared");

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
