#pragma once

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/gaussian.h"

namespace v3dg {

// Doubles that the rotations of the SH bands 1, 2 and 3 take: matrices of 3, 5 and 7 rows, one after another.
constexpr int kBandsSize = 3 * 3 + 5 * 5 + 7 * 7;

// Clusters of instances. An instance takes p to scale * rotation p + position.
struct GatherInput {
    Span<const GaussianRows<const float>> bundles;
    // [I] instances
    Span<const int32_t> bundle;
    Span<const double> position;    // [I * 3]
    Span<const double> rotation;    // [I * 9] rows
    Span<const double> quaternion;  // [I * 4] the same, w x y z
    Span<const double> scale;
    Span<const double> bands;  // [I * kBandsSize], or none when no bundle has more than SH degree 0
    // [S] clusters
    Span<const int32_t> instance;
    Span<const int64_t> first_row;  // in the bundle
    Span<const int64_t> offset;     // [S + 1] in the result, ascending from 0
};

// Writes the gaussians of all clusters in the world, in order; the SH coefficients that a bundle lacks are 0.
// Computed in double precision; both halves give the same bits.
namespace cpu { void gather(const GatherInput& in, const GaussianRows<float>& out); }
// Rows of bundles and `out` are on the device, all else on the host. Work is queued on the stream. Throws
// std::runtime_error when CUDA reports an error.
namespace cuda { void gather(const GatherInput& in, const GaussianRows<float>& out, Stream stream); }

}  // namespace v3dg
