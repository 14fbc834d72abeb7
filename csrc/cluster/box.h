#pragma once

// Axis-aligned boxes around the gaussians of clusters.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/bounds.h"

namespace v3dg {

struct BoxInput {
    const float *means, *quats, *scales;  // rows of the gaussians
    Span<const int64_t> offset;           // [C + 1] first gaussian of each cluster, then the end
};

// Computes a box around the gaussians of each cluster, as they are drawn. The box
// includes the extent of each gaussian as if it were opaque, but without the filter,
// and is rounded outwards. The box of an empty cluster extends from +inf to -inf. The
// CPU and CUDA compute the same bits.
namespace cpu { void bound_by_boxes(const BoxInput& in, Span<Box> box); }

// Like cpu::bound_by_boxes(), but rows and boxes are on the device, and offsets in host
// memory. The work is enqueued on the stream. Throws std::runtime_error if CUDA reports
// an error.
namespace cuda { void bound_by_boxes(const BoxInput& in, Span<Box> box, Stream stream); }

}  // namespace v3dg
