#pragma once

// Balls and axis-aligned boxes.

#include <cmath>

#include "base/host_device.h"

namespace v3dg {

// A ball with centre and radius.
struct Ball {
    float x, y, z, radius;
};

// A box with lower and upper corner.
struct Box {
    float lo[3], hi[3];
};

// Returns an empty box.
V3DG_HD inline Box no_box() {
    return {{INFINITY, INFINITY, INFINITY}, {-INFINITY, -INFINITY, -INFINITY}};
}

// Extends `box` so that it contains `other`.
V3DG_HD inline void grow(Box& box, const Box& other) {
    for (int a = 0; a < 3; ++a) {
        box.lo[a] = other.lo[a] < box.lo[a] ? other.lo[a] : box.lo[a];
        box.hi[a] = other.hi[a] > box.hi[a] ? other.hi[a] : box.hi[a];
    }
}

// Returns the smallest float32 that is not below `value`.
V3DG_HD inline float round_up(double value) {
    const float nearest = static_cast<float>(value);
    return nearest < value ? nextafterf(nearest, INFINITY) : nearest;
}

}  // namespace v3dg
