#pragma once

#include <cstdint>

#include "base/span.h"
#include "cluster/cluster_math.h"

namespace v3dg {

// Number of times that n points are halved until no part holds more than cluster_size (>= 1).
int num_halvings(size_t n, size_t cluster_size);

// Orders points so that each cluster of a perfect binary tree is contiguous.
//
// Every node is split at the median rank of the longest axis of its means' bounding box; the left part gets
// ceil(n / 2). Ties: the lowest axis, the lowest index to the left. All leaves are num_halvings() deep, so
// they hold ceil or floor of N / 2^depth points; none is empty unless cluster_size is 1 or N is 0. Within a
// leaf, indices ascend. The result does not depend on the number of threads.
//
// means: [N], finite, N < 2^32. order: [N], the index at each position. leaf_offset: [2^depth + 1].
//
// Source: Yang et al., Virtualized 3D Gaussians, SIGGRAPH 2025, median split of section 5 of the design.
namespace cpu {
void median_split(Span<const Point> means, int depth, Span<int64_t> order, Span<int64_t> leaf_offset);

// A ball around each segment of spheres (gaussians with their reach, or the balls of the groups below),
// within a fraction of a percent of the smallest one.
//
// Spheres of segment s are offset[s] .. offset[s + 1]. An empty segment gets a ball of kMinRadius at 0.
// `margin` widens the ball; kNestingMargin makes it contain the spheres in float32 arithmetic too.
// Rounded outwards, at least kMinRadius. The result does not depend on the number of threads.
void bound_spheres(Span<const Sphere> spheres, Span<const int64_t> offset, double margin, Span<Sphere> ball);
}  // namespace cpu

}  // namespace v3dg
