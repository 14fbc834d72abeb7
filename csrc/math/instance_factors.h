#pragma once

// The factors by which an instance multiplies the opacities and colours of its
// gaussians.

#include "math/gaussian.h"

namespace v3dg {

// Factors of red, green and blue, which are not negative, and of the opacity, 0 to 1.
struct InstanceFactors {
    float color[3] = {1, 1, 1};
    float opacity = 1;
};

// Returns whether a gaussian of an instance with this factor of the opacity may be
// drawn.
V3DG_HD inline bool may_show(const InstanceFactors& factors) {
    return factors.opacity >= static_cast<float>(kMinAlpha);
}

// Multiplies a colour, as color_of_coefficients() computes it. A channel that overflows
// becomes 0, so that it does not spread to pixels on which the gaussian has no weight.
template <class V>
V3DG_HD V3DG_INLINE void tint(const float factor[3], V color[3]) {
    using L = Lane<V>;
    for (int c = 0; c < 3; ++c) {
        const V tinted = color[c] * L(factor[c]);
        color[c] = tinted < all_lanes<V>(kInfinite<L>) ? tinted : V{};
    }
}

// Returns the SH coefficient of a colour that is multiplied by a factor. The factor
// also multiplies the 1/2 of every colour, which changes the constant basis.
V3DG_HD inline double tinted_coefficient(int basis, double coefficient, double factor) {
    const double tinted = factor * coefficient;
    return basis == 0 ? tinted + (factor - 1) * 0.5 / kShBase0 : tinted;
}

}  // namespace v3dg
