#pragma once

// Makes the gaussians that a coarser level starts from, by pruning or by merging.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/gaussian.h"

namespace v3dg {

// Segment g reduces gaussians in_offset[g] .. in_offset[g + 1] to as many as out_offset says, which
// is at most as many as come in. Decisions are made in the order of the rows, ties by index, and do
// not depend on threads; both halves give the same bits.
namespace cpu {
// Finds the gaussians with the largest opacity * (s1 s2 s3)^(2/3), the same share of each of the
// eight octants around the medians of a segment (V3DG, section 3.2). kept: [out_offset[S]], the
// rows in ascending order.
void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept);

// Joins pairs of gaussians, cheapest first, until as many are left as wanted. A pair becomes the
// gaussian with the same first and second moments, each weighted by opacity times surface area, and
// the same area times opacity as far as an opacity of 1 allows; its cost is how much its members
// differ in place and colour.
void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, const GaussianRows<float>& out);
}  // namespace cpu

// As cpu::, with rows and `kept` on the device; offsets stay on the host. Work is queued on the
// stream. Throws std::runtime_error when CUDA reports an error.
namespace cuda {
void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept, Stream stream);
void merge(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, const GaussianRows<float>& out, Stream stream);
}  // namespace cuda

}  // namespace v3dg
