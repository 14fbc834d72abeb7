#pragma once

// The solid angle of a ball.

#include "math/lanes.h"

namespace v3dg {

constexpr double kPi = 3.141592653589793;

// Returns the solid angle of a ball, 2 pi (1 - sqrt(1 - x2)), computed without
// cancellation. x2 is the square of radius / distance, and must be below 1. The result
// never decreases as x2 grows, because each operation is monotonic and exactly rounded.
template <class T>
V3DG_HD inline T solid_angle_of_ball(T x2) {
    return 2 * T(kPi) * x2 / (1 + sqrt_of(1 - x2));
}

}  // namespace v3dg
