#pragma once

// The instances of a scene: bundle, pose and importance of each.

#include <cstdint>

#include "base/span.h"
#include "math/similarity.h"

namespace v3dg {

// I similarity transforms p -> scale * rotation p + position. An instance is not drawn
// if its pose is not finite, its scale is not positive, or its quaternion is zero.
struct InstanceTable {
    Span<const int32_t> bundle;     // [I] index of the bundle in the scene
    Span<const double> position;    // [I * 3]
    Span<const double> quaternion;  // [I * 4] w x y z
    Span<const double> scale;       // [I]
    Span<const float> importance;   // [I] factor of the metrics

    V3DG_HD Pose pose(size_t i) const {
        return {position.data + 3 * i, quaternion.data + 4 * i, scale[i]};
    }
};

}  // namespace v3dg
