#pragma once

// The instances of a scene: the bundle, pose, importance and factors of each.

#include <cstdint>

#include "base/span.h"
#include "math/instance_factors.h"
#include "math/similarity.h"

namespace v3dg {

// Instances of bundles. An instance transforms a point p to scale * rotation p +
// position. It is not drawn if its pose is not finite, its scale is not positive, its
// quaternion is zero, or its opacity is below the smallest alpha that is drawn.
struct InstanceTable {
    Span<const int32_t> bundle;                // [I] index of the bundle in the scene
    Span<const double> position;               // [I * 3]
    Span<const double> quaternion;             // [I * 4] w x y z
    Span<const double> scale;                  // [I]
    Span<const float> importance;              // [I] the instance's metrics are multiplied by this
    Span<const InstanceFactors> factors = {};  // [I] empty if all are 1

    V3DG_HD Pose pose(size_t i) const {
        return {position.data + 3 * i, quaternion.data + 4 * i, scale[i]};
    }
    // Returns whether an instance is drawn. Its pose must be valid, and its opacity
    // large enough to be visible.
    V3DG_HD bool is_drawn(size_t i) const {
        return is_placed(pose(i)) && (factors.size == 0 || may_show(factors[i]));
    }
};

}  // namespace v3dg
