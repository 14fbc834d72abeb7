#pragma once

// The types that camera models use in their interface: a plane that bounds what a
// camera sees, the image of a sphere, a part of the image, and gradients on the image.

namespace v3dg {

// The requested part of an image, px: [x0, x1) x [y0, y1).
struct ImagePart {
    double x0, y0, x1, y1;
};

// A plane that bounds what a camera sees, moved outwards. A point is outside if normal
// . p + offset is positive.
struct Plane {
    float normal[3], offset;
    // How much farther the image of a gaussian may extend than its box, per unit of the
    // box's half depth, because the projection is linearised at the gaussian's mean.
    float guard;
};

// The image of a sphere, px: its centre, and a bound on its extent from there in x and
// y.
template <class T>
struct SphereImage {
    T u, v, half;
};

// The projection of a gaussian with mean p and axes m in view space: the pixel and the
// depth of its mean, and the rows a1 and a2 of the Jacobian times m. Also the gradients
// of these.
template <class V>
struct LinearImage {
    V u, v, depth;
    V a1[3], a2[3];
};

}  // namespace v3dg
