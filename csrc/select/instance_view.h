#pragma once

// The camera in the coordinates of an instance. Selection reads nothing else about a
// camera.

#include "camera/camera.h"
#include "math/similarity.h"

namespace v3dg {

// The number of planes of a frustum.
constexpr int kNumPlanes = Intrinsics<double>::kNumPlanes;

// A camera, or two eyes, in the coordinates and units of one instance. With two eyes,
// distances are measured to the nearer eye, and the planes enclose both frusta. Because
// of its alignment, a thread can load the struct in few instructions.
struct alignas(16) InstanceView {
    float eye[3], other_eye[3];
    bool has_other_eye;
    // The viewing direction of a pinhole camera as a unit vector. For other models, it
    // is the guard direction.
    float forward[3];
    float px2_per_steradian;  // the camera's value times the instance's importance
    Plane plane[kNumPlanes];  // a gaussian outside any of these planes is not drawn
};

// The side planes of a frustum in camera coordinates, around both eyes. They are the
// same for all instances of a bundle.
using CameraSides = Intrinsics<double>::Sides;

// Returns the side planes around the drawn part of the image. They are moved outwards
// by pad_px.
V3DG_HD inline CameraSides sides_of_eyes(const Eyes& eyes, double pad_px) {
    return Intrinsics<double>::sides_of(eyes.camera, eyes.count(), pad_px);
}

// Transforms the camera into the coordinates of an instance. `in` has the axes of the
// first eye, and `sides` belong to the instance's bundle. The function is compiled
// without floating-point contraction, so that the CPU and CUDA compute the same bits.
V3DG_HD inline InstanceView view_from_instance(const Eyes& eyes, const CameraSides& sides,
                                               const InstanceAxes& in, const Pose& pose,
                                               float importance) {
    const Camera& camera = eyes.camera[0];
    double front = camera.front_offset(in, 1.0 / pose.scale), px2 = camera.px2_per_steradian();
    InstanceAxes other = in;
    if (eyes.are_two) {
        const Camera& second = eyes.camera[1];
        other = axes_of_instance(second, pose);
        front = min_of(front, second.front_offset(other, 1.0 / pose.scale));
        px2 = max_of(px2, second.px2_per_steradian());
    }
    InstanceView view;
    view.px2_per_steradian = static_cast<float>(px2) * importance;
    view.has_other_eye = eyes.are_two;
    for (int k = 0; k < 3; ++k) view.eye[k] = static_cast<float>(in.eye[k]);
    for (int k = 0; k < 3; ++k) view.other_eye[k] = static_cast<float>(other.eye[k]);
    camera.set_guard_direction(in, view.forward);
    Intrinsics<double>::set_planes(sides, in, other, front, view.plane);
    return view;
}

}  // namespace v3dg
