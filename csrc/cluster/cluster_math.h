#pragma once

#include <cmath>
#include <cstddef>
#include <limits>

#include "base/host_device.h"

namespace v3dg {

struct Point {
    float axis[3];
};

// Centre and radius, in the asset's own frame and units.
struct Sphere {
    float x, y, z, radius;
};

// A ball contains another with this relative margin, so that rounding in the float32 footprint (about 1e-6)
// cannot turn their order round.
constexpr double kNestingMargin = 4e-6;

// Squares of radii stay normal numbers, so that they keep their relative precision.
constexpr float kMinRadius = 1e-15f;

struct Center {
    double x, y, z;
};

// Distance from `center` to the farthest point of the sphere.
inline double reach(const Center& center, const Sphere& sphere) {
    const double dx = sphere.x - center.x, dy = sphere.y - center.y, dz = sphere.z - center.z;
    return std::sqrt(dx * dx + dy * dy + dz * dz) + sphere.radius;
}

// The smallest float32 that is not below `value`.
inline float round_up(double value) {
    const float nearest = static_cast<float>(value);
    return nearest < value ? std::nextafter(nearest, std::numeric_limits<float>::infinity()) : nearest;
}

}  // namespace v3dg
