#pragma once

// The order of points along a Morton curve.

#include <cstdint>

#include "base/span.h"
#include "cluster/cluster_math.h"

namespace v3dg {

// Computes indices that put points along a curve that keeps neighbours together; they are the same
// on every run. Points are finite.
void morton_order(Span<const Point> points, Span<int64_t> order);

}  // namespace v3dg
