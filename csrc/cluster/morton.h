#pragma once

#include <cstdint>

#include "base/span.h"
#include "cluster/cluster_math.h"

namespace v3dg {

// Indices that put points along a curve that keeps neighbours together; the same on every run.
// Points are finite.
void morton_order(Span<const Point> points, Span<int64_t> order);

}  // namespace v3dg
