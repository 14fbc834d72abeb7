#pragma once

#include "math/lanes.h"

namespace v3dg {

constexpr double kPi = 3.141592653589793;

// Of a ball whose radius over its distance, squared, is x2 < 1: 2 pi (1 - sqrt(1 - x2)), without
// its cancellation. A chain of correctly rounded operations that never falls when x2 grows.
template <class T>
V3DG_HD inline T solid_angle_of_ball(T x2) {
    return 2 * T(kPi) * x2 / (1 + sqrt_of(1 - x2));
}

}  // namespace v3dg
