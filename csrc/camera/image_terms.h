#pragma once

// The types in the interface of camera models: bounding planes, the image of a sphere,
// a part of an image, and a projected gaussian.

namespace v3dg {

// The part of the image that is drawn, px: x in [x0, x1) and y in [y0, y1).
struct ImagePart {
    double x0, y0, x1, y1;
};

// A plane of a camera's frustum. A point p is outside if normal . p + offset is
// positive.
struct Plane {
    float normal[3], offset;
    // A margin. The linearised image of a gaussian may extend beyond the true
    // projection of its box. `guard` bounds by how much, relative to the box's half
    // extent along the guard direction of the model. For a pinhole camera, this
    // direction is the depth.
    float guard;
};

// The image of a sphere, px: its centre (u, v), and an upper bound on its half extent
// in x and in y.
template <class T>
struct SphereImage {
    T u, v, half;
};

// The projection of a gaussian: the pixel (u, v) and the depth of its mean, and the
// rows a1 and a2 of the Jacobian times the gaussian's axes in view space. The same
// struct also holds the gradients of these values.
template <class V>
struct LinearImage {
    V u, v, depth;
    V a1[3], a2[3];
};

}  // namespace v3dg
