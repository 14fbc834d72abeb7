#pragma once

// The terms in which a camera model answers: a plane that bounds what it sees, the image of a
// sphere, a part of the image, and gradients on the image.

namespace v3dg {

// The part of an image that is wanted, px: [x0, x1) x [y0, y1).
struct ImagePart {
    double x0, y0, x1, y1;
};

// A plane that bounds what a camera sees, pushed outwards. A point is outside when normal . p +
// offset is positive.
struct Plane {
    float normal[3], offset;
    // A gaussian's image reaches this much farther, per unit of its box's half depth, than the box
    // itself, because its projection is linearised at its mean.
    float guard;
};

// The image of a sphere, px: its centre, and a bound on how far it reaches from there in x and y.
template <class T>
struct SphereImage {
    T u, v, half;
};

// What projection makes of a gaussian with mean p and axes m in view space: the pixel and the depth
// of its mean, and the rows a1 and a2 of the Jacobian times m. Also the gradients of these.
template <class V>
struct LinearImage {
    V u, v, depth;
    V a1[3], a2[3];
};

}  // namespace v3dg
