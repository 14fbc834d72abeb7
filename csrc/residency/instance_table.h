#pragma once

#include <cstdint>

#include "base/span.h"
#include "math/similarity.h"

namespace v3dg {

// Similarity transforms p -> scale * rotation p + position. An instance whose pose is not finite,
// or has no size, is not drawn.
struct InstanceTable {
    Span<const int32_t> bundle;     // [I] which of the scene's bundles
    Span<const double> position;    // [I * 3]
    Span<const double> quaternion;  // [I * 4] w x y z
    Span<const double> scale;       // [I]
    Span<const float> importance;   // [I] metrics are multiplied by it

    V3DG_HD Pose pose(size_t i) const {
        return {position.data + 3 * i, quaternion.data + 4 * i, scale[i]};
    }
};

}  // namespace v3dg
