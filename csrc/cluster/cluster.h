#pragma once

// Sorts an asset's gaussians into clusters, and bounds groups of gaussians by balls.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "cluster/cluster_math.h"

namespace v3dg {

// Returns how often n points are halved until no part has more than cluster_size (>=
// 1).
int num_halvings(size_t n, size_t cluster_size);

// Computes the beginnings of the leaves if each segment is halved `depth` times; the
// left part gets ceil(n / 2) points.
//
// offset: [S + 1], ascending from 0. leaf_offset: [S * 2^depth + 1].
void halve_segments(Span<const int64_t> offset, int depth, Span<int64_t> leaf_offset);

// Sorts points so that each chunk of chunk_size (>= 1) has neighbours; only the last
// chunk may be smaller.
//
// Nodes are split between whole chunks, at the median chunk along the longest axis of
// their points' bounding box, with ties as in median_split. Indices ascend in each
// chunk. The result does not depend on the number of threads.
//
// means: [N], on the host, finite, N < 2^32. order: [N], the index at each position.
void chunk_order(Span<const Point> means, size_t chunk_size, Span<int64_t> order);

// Sorts the points of each segment so that each cluster of a perfect binary tree is
// contiguous.
//
// Every node is split `depth` times at the median rank along the longest axis of its
// means' bounding box. Ties go to the lowest axis, and to the left for the lowest
// index. Leaf l of segment s is s * 2^depth + l; it has ceil or floor of n / 2^depth of
// the segment's points, and its indices ascend. The result does not depend on the
// number of threads; the CPU and CUDA give the same bits.
//
// means: [N], finite, N < 2^32. offset: [S + 1], ascending from 0 to N. order: [N], the
// index at each position. leaf_offset: [S * 2^depth + 1].
//
// This split is also the tree of clusters; docs/levels.md compares it with the paper's
// (V3DG).
namespace cpu {
void median_split(Span<const Point> means, Span<const int64_t> offset, int depth,
                  Span<int64_t> order, Span<int64_t> leaf_offset);

// Computes a ball around each segment of spheres (gaussians with their reach, or the
// balls of the groups below). Its radius is within a fraction of a percent of the
// smallest possible.
//
// Segment s has the spheres offset[s] .. offset[s + 1]. An empty segment gets a ball of
// kMinRadius at 0. `margin` widens the ball; with kNestingMargin the ball contains the
// spheres in float32 arithmetic, too. Radii are rounded up and at least kMinRadius. The
// result does not depend on the number of threads; the CPU and CUDA give the same bits.
void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                   Span<Ball> ball);
}  // namespace cpu

// As cpu::, with means, order, spheres and ball on the device; offsets stay on the
// host. Work is queued on the stream. Throws std::runtime_error if CUDA reports an
// error.
namespace cuda {
void median_split(Span<const Point> means, Span<const int64_t> offset, int depth,
                  Span<int64_t> order, Span<int64_t> leaf_offset, Stream stream);
void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                   Span<Ball> ball, Stream stream);
}  // namespace cuda

}  // namespace v3dg
