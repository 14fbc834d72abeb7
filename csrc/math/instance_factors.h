#pragma once

// Factors that multiply the opacities and colours of an instance's gaussians.

#include "math/gaussian.h"

namespace v3dg {

// Factors of red, green and blue (at least 0) and of the opacity (0 to 1).
struct InstanceFactors {
    float color[3] = {1, 1, 1};
    float opacity = 1;
};

// Returns whether an instance with these factors may be visible.
V3DG_HD inline bool may_show(const InstanceFactors& factors) {
    return factors.opacity >= static_cast<float>(kMinAlpha);
}

// Multiplies a colour from color_of_coefficients() by factors. A channel that overflows
// becomes 0. If it stayed infinite, pixels in which the gaussian has weight 0 would
// become NaN.
template <class V>
V3DG_HD V3DG_INLINE void tint(const float factor[3], V color[3]) {
    using L = Lane<V>;
    for (int c = 0; c < 3; ++c) {
        const V tinted = color[c] * L(factor[c]);
        color[c] = tinted < all_lanes<V>(kInfinite<L>) ? tinted : V{};
    }
}

// Returns the SH coefficient of a colour that is multiplied by a factor. A colour is
// 1/2 plus a sum. The factor also multiplies the 1/2, which changes the coefficient of
// degree 0.
V3DG_HD inline double tinted_coefficient(int basis, double coefficient, double factor) {
    const double tinted = factor * coefficient;
    return basis == 0 ? tinted + (factor - 1) * 0.5 / kShBase0 : tinted;
}

}  // namespace v3dg
