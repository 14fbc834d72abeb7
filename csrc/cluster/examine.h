#pragma once

// Checks which gaussians of an asset can be drawn.

#include <cstdint>

#include "base/span.h"
#include "math/gaussian.h"

namespace v3dg {

// Reasons why a gaussian cannot be drawn: bits, of which it may have several. All but the last are
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
    kTransparent = 1 << 8,  // no pixel shows it
};

// The largest coordinate or scale, in world units: squares of larger ones exceed float32.
constexpr float kMostLength = 1e18f;

// Sets findings, [N], to 0 where a gaussian can be drawn.
void examine(const GaussianRows<const float>& in, Span<uint16_t> findings);

}  // namespace v3dg
