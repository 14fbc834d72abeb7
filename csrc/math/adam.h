#pragma once

// A step of Adam (Kingma and Ba 2015, algorithm 1), for one parameter or for a vector
// of parameters.

#include "math/lanes.h"

namespace v3dg {

constexpr double kAdamBeta1 = 0.9, kAdamEpsilon = 1e-15;

// Returns the value after a step, and updates the moments `m` and `v`. `beta2` is the
// decay of `v`. `correction1` and `correction2` are 1 / (1 - beta^step).
template <class V, class T>
V3DG_HD V3DG_INLINE V adam_step(V value, V gradient, V& m, V& v, T step_size, T beta2,
                                T correction1, T correction2) {
    m = T(kAdamBeta1) * m + T(1 - kAdamBeta1) * gradient;
    v = beta2 * v + (1 - beta2) * gradient * gradient;
    return value - step_size * correction1 * m / (sqrt_of(v * correction2) + T(kAdamEpsilon));
}

}  // namespace v3dg
