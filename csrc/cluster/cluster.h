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
// left part gets left_half(n, unit) of n points.
//
// offset: [S + 1], ascending from 0. unit: >= 1. leaf_offset: [S * 2^depth + 1].
void halve_segments(Span<const int64_t> offset, int depth, size_t unit, Span<int64_t> leaf_offset);

// Sorts the points of each segment so that each cluster of a perfect binary tree is
// contiguous.
//
// Every node is split `depth` times at the median rank along the longest axis of its
// means' bounding box. Ties go to the lowest axis, and to the left for the lowest
// index. Leaf l of segment s is s * 2^depth + l, and its indices ascend. With a unit of
// 1 it has ceil or floor of n / 2^depth of the segment's points; with a larger unit,
// all leaves but the last one that is not empty begin and end at multiples of it,
// counted from the segment's first position. The result does not depend on the number
// of threads; the CPU and CUDA give the same bits.
//
// means: [N], finite, N < 2^32. offset: [S + 1], ascending from 0 to N. unit: >= 1.
// order: [N], the index at each position. leaf_offset: [S * 2^depth + 1].
//
// This split is also the tree of clusters; docs/levels.md compares it with the paper's
// (V3DG).
namespace cpu {
void median_split(Span<const Point> means, Span<const int64_t> offset, int depth, size_t unit,
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
void median_split(Span<const Point> means, Span<const int64_t> offset, int depth, size_t unit,
                  Span<int64_t> order, Span<int64_t> leaf_offset, Stream stream);
void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                   Span<Ball> ball, Stream stream);
}  // namespace cuda

}  // namespace v3dg
