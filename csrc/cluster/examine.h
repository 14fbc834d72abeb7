#pragma once

// Checks which gaussians of an asset can be drawn.

#include <cstdint>

#include "base/span.h"
#include "math/gaussian.h"

namespace v3dg {

// Bits for the reasons why a gaussian cannot be drawn. All but the last are invalid
// values.
enum Finding : uint16_t {
    kMeanNotFinite = 1 << 0,
    kQuatNotFinite = 1 << 1,
    kScaleNotFinite = 1 << 2,
    kOpacityNotFinite = 1 << 3,
    kShNotFinite = 1 << 4,
    kTooLarge = 1 << 5,
    kNegativeScale = 1 << 6,
    kOpacityOutOfRange = 1 << 7,
    kTransparent = 1 << 8,  // it is invisible
};

// The largest coordinate or scale, in world units: squares of larger ones exceed
// float32.
constexpr float kMostLength = 1e18f;

// Writes [N] findings: 0 if a gaussian can be drawn.
void examine(const GaussianRows<const float>& in, Span<uint16_t> findings);

}  // namespace v3dg
