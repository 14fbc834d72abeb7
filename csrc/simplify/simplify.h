#pragma once

// Computes the initial gaussians of a coarser level, by pruning or by merging.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/gaussian.h"

namespace v3dg {

// Segment g has the gaussians from in_offset[g] to in_offset[g + 1]. It is reduced to
// out_offset[g + 1] - out_offset[g] gaussians, which must not exceed the number that it
// has. Ties are broken by index. The result has the same bits on the CPU and on CUDA,
// for any number of threads.
namespace cpu {
// In each of the eight octants around the medians of a segment, keeps the gaussians
// with the largest opacity * (s1 s2 s3)^(2/3) (V3DG, section 3.2). The same fraction of
// each octant is kept. `kept` receives the kept rows in ascending order:
// [out_offset[S]] for S segments.
void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept);

// Joins pairs of gaussians, cheapest first, until the wanted number is left. The cost
// of a pair grows with the distance between its gaussians in position and in colour. A
// joined gaussian has the first and second moments of the pair, weighted by opacity
// times surface area. Its opacity is chosen to preserve the sum of area times opacity,
// but is at most 1.
void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, const GaussianRows<float>& out);
}  // namespace cpu

// Like the functions of cpu::, but rows and `kept` are on the device, and offsets in
// host memory. The work is enqueued on the stream. Throws std::runtime_error if CUDA
// reports an error.
namespace cuda {
void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept, Stream stream);
void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, const GaussianRows<float>& out, Stream stream);
}  // namespace cuda

}  // namespace v3dg
