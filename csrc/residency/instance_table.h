#pragma once

// The instances of a scene: which bundle, where, how important, and in what colour.

#include <cstdint>

#include "base/span.h"
#include "math/instance_factors.h"
#include "math/similarity.h"

namespace v3dg {

// I similarity transforms p -> scale * rotation p + position. An instance is not drawn if its
// pose is not finite, its scale not positive, its quaternion zero, or its opacity below the least
// alpha that is drawn.
struct InstanceTable {
    Span<const int32_t> bundle;                // [I] number among the bundles of the scene
    Span<const double> position;               // [I * 3]
    Span<const double> quaternion;             // [I * 4] w x y z
    Span<const double> scale;                  // [I]
    Span<const float> importance;              // [I] factor of the metrics
    Span<const InstanceFactors> factors = {};  // [I] empty where all are 1

    V3DG_HD Pose pose(size_t i) const {
        return {position.data + 3 * i, quaternion.data + 4 * i, scale[i]};
    }
    // Whether an instance is drawn: it has a pose, and is not transparent.
    V3DG_HD bool is_drawn(size_t i) const {
        return is_placed(pose(i)) && (factors.size == 0 || may_show(factors[i]));
    }
};

}  // namespace v3dg
