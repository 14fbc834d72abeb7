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
// 3. Add the model to Intrinsics<T>, the only place that chooses a model. Intrinsics<T>
//    is an alias while there is one model. With several models, make it a struct that
//    holds a tag and one of the models, and whose members call the members of that
//    model. Such a struct satisfies CameraModel itself, so kernels do not change.
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
//   point is drawn if its depth is at least near_depth.
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

#include <concepts>
#include <cstring>
#include <type_traits>

#include "camera/image_terms.h"
#include "camera/pinhole.h"
#include "math/similarity.h"
#include "math/view.h"

namespace v3dg {

// The camera model in use.
template <class T>
using Intrinsics = Pinhole<T>;

// A camera in the world, in double precision: its pose, its camera model, and the
// requested part of its image.
struct Camera : CameraPose, Intrinsics<double>, ImagePart {
    // Returns the camera model with scalar type T.
    template <class T>
    V3DG_HD Intrinsics<T> intrinsics() const {
        return rounded_to<T>();
    }
    // Returns this camera with `factor` times the resolution.
    V3DG_HD Camera scaled(double factor) const {
        Camera camera = *this;
        camera.scale(factor);
        camera.x0 *= factor;
        camera.y0 *= factor;
        camera.x1 *= factor;
        camera.y1 *= factor;
        return camera;
    }
    // Returns a camera whose image is the given rectangle of this camera's image, px.
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
static_assert(sizeof(Camera) == 26 * sizeof(double),
              "operator== compares all bytes, so Camera must have no padding");

// Returns a camera with the given projection, whose whole image is requested. The
// caller sets the pose.
inline Camera with_projection(const Intrinsics<double>& projection) {
    return {CameraPose{}, projection, ImagePart{0, 0, projection.width, projection.height}};
}

// The viewpoint for which a cut is selected: one camera, or the two eyes of a stereo
// camera. The rotations of the two eyes are equal.
struct Eyes {
    Camera camera[2];  // equal to each other if there is one eye
    bool are_two;

    Eyes() : Eyes(Camera{}) {}
    V3DG_HD Eyes(const Camera& only) : camera{only, only}, are_two(false) {}
    V3DG_HD Eyes(const Camera& left, const Camera& right) : camera{left, right}, are_two(true) {}
    V3DG_HD int count() const { return are_two ? 2 : 1; }
    // Compares bits, so NaN equals itself and -0 differs from 0.
    bool operator==(const Eyes& other) const {
        return are_two == other.are_two && std::memcmp(camera, other.camera, sizeof camera) == 0;
    }
};

// The part of CameraModel that projection uses.
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

// The part of CameraModel that selection uses.
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
