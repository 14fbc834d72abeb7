#pragma once

// Sorts points along a Morton curve.

#include <cstdint>

#include "base/span.h"
#include "cluster/cluster_math.h"

namespace v3dg {

// Computes the order of points along a Morton curve. Adjacent points in this order are
// close in space. Every run gives the same order. Points must be finite.
void morton_order(Span<const Point> points, Span<int64_t> order);

}  // namespace v3dg
