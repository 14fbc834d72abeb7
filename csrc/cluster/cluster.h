#pragma once

// Orders an asset's gaussians into clusters, and bounds groups of them by balls.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "cluster/cluster_math.h"

namespace v3dg {

// Returns the number of times that n points are halved until no part holds more than cluster_size
// (>= 1).
int num_halvings(size_t n, size_t cluster_size);

// Computes where the leaves begin when each segment is halved `depth` times; the left part gets
// ceil(n / 2) points.
//
// offset: [S + 1], ascending from 0. leaf_offset: [S * 2^depth + 1].
void halve_segments(Span<const int64_t> offset, int depth, Span<int64_t> leaf_offset);

// Orders the points of each segment so that each cluster of a perfect binary tree is contiguous.
//
// Every node is split at the median rank of the longest axis of its means' bounding box, `depth`
// times. Ties: the lowest axis, the lowest index to the left. Leaf l of segment s is s * 2^depth +
// l; it holds ceil or floor of n / 2^depth of the segment's points, and its indices ascend. The
// result does not depend on the number of threads; both halves give the same bits.
//
// means: [N], finite, N < 2^32. offset: [S + 1], ascending from 0 to N. order: [N], the index at
// each position. leaf_offset: [S * 2^depth + 1].
//
// The tree of clusters is this split itself; docs/levels.md compares it with the paper's (V3DG).
namespace cpu {
void median_split(Span<const Point> means, Span<const int64_t> offset, int depth,
                  Span<int64_t> order, Span<int64_t> leaf_offset);

// Finds a ball around each segment of spheres (gaussians with their reach, or the balls of the
// groups below), whose radius is within a fraction of a percent of the smallest one.
//
// Segment s has the spheres offset[s] .. offset[s + 1]. An empty segment gets a ball of kMinRadius
// at 0. `margin` widens the ball; kNestingMargin makes it contain the spheres in float32
// arithmetic, too. Radii are rounded up and at least kMinRadius. The result does not depend on the
// number of threads; both halves give the same bits.
void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                   Span<Ball> ball);
}  // namespace cpu

// As cpu::, with means, order, spheres and ball on the device; offsets stay on the host. Work is
// queued on the stream. Throws std::runtime_error when CUDA reports an error.
namespace cuda {
void median_split(Span<const Point> means, Span<const int64_t> offset, int depth,
                  Span<int64_t> order, Span<int64_t> leaf_offset, Stream stream);
void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                   Span<Ball> ball, Stream stream);
}  // namespace cuda

}  // namespace v3dg
