#pragma once

// Sorts the gaussians of an asset into clusters, and computes bounding balls.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "cluster/cluster_math.h"

namespace v3dg {

// Returns how often n points must be halved until each part has at most cluster_size
// points. Precondition: cluster_size >= 1.
int num_halvings(size_t n, size_t cluster_size);

// Computes where leaves begin if each segment is halved `depth` times. The left half of
// n points has left_half(n, unit) points (cluster_math.h).
//
// offset: [S + 1], ascending from 0. unit: >= 1. leaf_offset: [S * 2^depth + 1].
void halve_segments(Span<const int64_t> offset, int depth, size_t unit, Span<int64_t> leaf_offset);

// Sorts the points of each segment such that, for each node of a perfect binary tree,
// the points of the node are contiguous. The leaves of the tree are clusters.
// docs/levels.md compares the tree with that of the paper (V3DG).
//
// A node is split at the median along the longest axis of the bounding box of its
// points; if axes are equal, the first one is used. Points of equal coordinate are
// ordered by index. Leaf l of segment s has the number s * 2^depth + l, and its points
// are in ascending order of their indices. If the unit is 1, the leaf has floor or ceil
// of n / 2^depth of the segment's n points. If the unit is larger, leaves begin at
// multiples of the unit, counted from the start of the segment, and may be empty. The
// result has the same bits on the CPU and on CUDA, for any number of threads.
//
// means: [N], finite, N < 2^32. offset: [S + 1], ascending from 0 to N. unit: >= 1.
// order: [N], index of the point at each position. leaf_offset: [S * 2^depth + 1].
namespace cpu {
void median_split(Span<const Point> means, Span<const int64_t> offset, int depth, size_t unit,
                  Span<int64_t> order, Span<int64_t> leaf_offset);

// Computes a ball around the spheres of each segment. The spheres are gaussians with
// their extent, or the balls of the groups below. The radius is within a fraction of a
// percent of the smallest possible radius.
//
// Segment s has the spheres from offset[s] to offset[s + 1]. The ball of an empty
// segment is at 0 and has the radius kMinRadius. Radii are enlarged by the relative
// `margin`. With kNestingMargin, the ball contains the spheres even in float32
// arithmetic. Radii are rounded up, and are at least kMinRadius. The result has the
// same bits on the CPU and on CUDA, for any number of threads.
void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                   Span<Ball> ball);
}  // namespace cpu

// Like the functions of cpu::, but means, order, spheres and balls are on the device,
// and offsets in host memory. The work is enqueued on the stream. Throws
// std::runtime_error if CUDA reports an error.
namespace cuda {
void median_split(Span<const Point> means, Span<const int64_t> offset, int depth, size_t unit,
                  Span<int64_t> order, Span<int64_t> leaf_offset, Stream stream);
void bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                   Span<Ball> ball, Stream stream);
}  // namespace cuda

}  // namespace v3dg
