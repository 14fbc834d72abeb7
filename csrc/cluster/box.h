#pragma once

// Boxes around the visible extent of clusters.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/bounds.h"

namespace v3dg {

struct BoxInput {
    const float *means, *quats, *scales;  // rows of the gaussians
    Span<const int64_t> offset;           // [C + 1] gaussians of each cluster
};

// Bounds what clusters draw: each box contains the reach of an opaque gaussian around
// every mean, rounded outwards, but not the reach of the filter. The box of a cluster
// without gaussians is empty: +inf to -inf. The CPU and CUDA give the same bits.
namespace cpu { void bound_by_boxes(const BoxInput& in, Span<Box> box); }

// Rows and boxes are on the device, offsets on the host. Work is queued on the stream.
// Throws std::runtime_error if CUDA reports an error.
namespace cuda { void bound_by_boxes(const BoxInput& in, Span<Box> box, Stream stream); }

}  // namespace v3dg
