#pragma once

// Axis-aligned boxes around what clusters draw.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/bounds.h"

namespace v3dg {

struct BoxInput {
    const float *means, *quats, *scales;  // rows of the gaussians
    Span<const int64_t> offset;           // [C + 1] first gaussian of each cluster, and the end
};

// Computes a box around what each cluster draws. The box contains the reach of each
// gaussian as if it were opaque, but not the reach of the filter, and is rounded
// outwards. The box of a cluster without gaussians is from +inf to -inf. The CPU and
// CUDA compute the same bits.
namespace cpu { void bound_by_boxes(const BoxInput& in, Span<Box> box); }

// Like cpu::bound_by_boxes(), with rows and boxes on the device, and offsets in host
// memory. Work is enqueued on the stream. Throws std::runtime_error if CUDA reports an
// error.
namespace cuda { void bound_by_boxes(const BoxInput& in, Span<Box> box, Stream stream); }

}  // namespace v3dg
