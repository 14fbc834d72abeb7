#pragma once

// Computes the initial gaussians of a coarser level, by pruning or by merging.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/gaussian.h"

namespace v3dg {

// Segment g has the gaussians from in_offset[g] to in_offset[g + 1]. It is reduced to
// out_offset[g + 1] - out_offset[g] gaussians. This number must not exceed the number
// of gaussians that the segment has. Ties are decided by index. The result has the same
// bits on the CPU and on CUDA, for any number of threads.
namespace cpu {
// Keeps the gaussians with the largest opacity * (s1 s2 s3)^(2/3) in each of the eight
// octants around the medians of a segment (V3DG, section 3.2). It keeps the same share
// of each octant. `kept` becomes the kept rows, in ascending order: [out_offset[S]] for
// S segments.
void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept);

// Joins pairs of gaussians, cheapest first, until the wanted number is left. The cost
// of a pair grows with the distance between its gaussians in position and in colour.
// The joined gaussian has the first and second moments of the pair, weighted by opacity
// times surface area. Its area times opacity is the pair's total, as far as an opacity
// of 1 allows.
void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, const GaussianRows<float>& out);
}  // namespace cpu

// Like the functions of cpu::, with rows and `kept` on the device, and offsets in host
// memory. Work is enqueued on the stream. Throws std::runtime_error if CUDA reports an
// error.
namespace cuda {
void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept, Stream stream);
void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, const GaussianRows<float>& out, Stream stream);
}  // namespace cuda

}  // namespace v3dg
