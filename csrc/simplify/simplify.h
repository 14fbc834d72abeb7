#pragma once

// Computes the initial gaussians of a coarser level, by pruning or by merging.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/gaussian.h"

namespace v3dg {

// Segment g reduces gaussians in_offset[g] .. in_offset[g + 1] to the number that
// out_offset gives, which is at most the number of inputs. Ties are decided by index,
// and results do not depend on threads; the CPU and CUDA give the same bits.
namespace cpu {
// Finds the gaussians with the largest opacity * (s1 s2 s3)^(2/3), the same share of
// each of the eight octants around the medians of a segment (V3DG, section 3.2). kept:
// [out_offset[S]], the rows in ascending order.
void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept);

// Joins pairs of gaussians, cheapest first, until the wanted number is left. A pair
// becomes the gaussian with the same first and second moments, each weighted by opacity
// times surface area, and the same area times opacity as far as an opacity of 1 allows.
// The cost of a pair grows with the differences of its members in position and colour.
void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, const GaussianRows<float>& out);
}  // namespace cpu

// As cpu::, with rows and `kept` on the device; offsets stay on the host. Work is
// queued on the stream. Throws std::runtime_error if CUDA reports an error.
namespace cuda {
void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept, Stream stream);
void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, const GaussianRows<float>& out, Stream stream);
}  // namespace cuda

}  // namespace v3dg
