#pragma once

// Checks which gaussians of an asset can be drawn.

#include <cstdint>

#include "base/span.h"
#include "math/gaussian.h"

namespace v3dg {

// The reasons why a gaussian cannot be drawn, one bit each. All except kTransparent are
// invalid values.
enum Finding : uint16_t {
    kMeanNotFinite = 1 << 0,
    kQuatNotFinite = 1 << 1,
    kScaleNotFinite = 1 << 2,
    kOpacityNotFinite = 1 << 3,
    kShNotFinite = 1 << 4,
    kTooLarge = 1 << 5,
    kNegativeScale = 1 << 6,
    kOpacityOutOfRange = 1 << 7,
    kTransparent = 1 << 8,  // valid, but invisible
};

// The largest coordinate or scale, in world units. Squares of larger values would
// overflow float32.
constexpr float kMostLength = 1e18f;

// Computes the findings of all gaussians, [N]. A gaussian with the value 0 can be
// drawn.
void examine(const GaussianRows<const float>& in, Span<uint16_t> findings);

}  // namespace v3dg
