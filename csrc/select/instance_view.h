#pragma once

// The camera in the coordinates of one instance; selection reads nothing else of a
// camera.

#include "camera/camera.h"
#include "math/similarity.h"

namespace v3dg {

// The number of planes that bound what a camera sees.
constexpr int kNumPlanes = Intrinsics<double>::kNumPlanes;

// A camera, or two eyes, in the coordinates and units of one instance. With two eyes,
// distances are to the nearer one, and the planes enclose both frusta. The struct is
// aligned so that a thread reads and writes it in few instructions.
struct alignas(16) InstanceView {
    float eye[3], other_eye[3];
    bool has_other_eye;
    float forward[3];         // the direction of the camera, unit length
    float px2_per_steradian;  // of the camera, times the importance of the instance
    Plane plane[kNumPlanes];  // what lies outside of any plane is not drawn
};

// The frustum planes of both eyes in camera coordinates, the same for all instances of
// a bundle.
using CameraSides = Intrinsics<double>::Sides;

// Returns planes pad_px outside of the requested part of the image.
V3DG_HD inline CameraSides sides_of_eyes(const Eyes& eyes, double pad_px) {
    return Intrinsics<double>::sides_of(eyes.camera, eyes.count(), pad_px);
}

// Transforms the cameras into the coordinates of an instance. `in` has the axes of the
// first eye, `sides` the planes for the instance's bundle. The CPU and CUDA compile
// this without contraction, so that both give the same bits.
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
    for (int k = 0; k < 3; ++k) view.forward[k] = static_cast<float>(in.axes[6 + k]);
    Intrinsics<double>::set_planes(sides, in, other, front, view.plane);
    return view;
}

}  // namespace v3dg
