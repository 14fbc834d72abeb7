#pragma once

// The box of one gaussian, for the CPU and CUDA. It is compiled without floating-point
// contraction, so that both compute the same bits.

#include <cmath>

#include "math/bounds.h"
#include "math/gaussian.h"

namespace v3dg {

// Returns the box of one gaussian as it is drawn. The computation is in double
// precision, because the scales of a gaussian may differ as much as 1e-6 and 1e6.
V3DG_HD inline Box box_of_gaussian(const float* mean, const float* quat, const float* scale) {
    const double q[4] = {quat[0], quat[1], quat[2], quat[3]};
    double r[9];
    rotation_of_quat(q, r);
    Box box;
    for (int a = 0; a < 3; ++a) {
        double variance = 0;
        for (int k = 0; k < 3; ++k) {
            const double side = r[3 * a + k] * scale[k];
            variance += side * side;
        }
        // Add a margin, because corners are rounded to float32.
        const double reach = kReachSigmas * 1.0001 * sqrt(variance) + 1e-6 * fabs(double(mean[a]));
        box.lo[a] = static_cast<float>(mean[a] - reach);
        box.hi[a] = static_cast<float>(mean[a] + reach);
    }
    return box;
}

}  // namespace v3dg
