#pragma once

// Gathers the gaussians of instances' clusters, transformed into the world.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/gaussian.h"
#include "math/instance_factors.h"

namespace v3dg {

// Clusters of instances. An instance transforms p to scale * rotation p + position.
struct GatherInput {
    Span<const GaussianRows<const float>> bundles;
    // [I] instances
    Span<const int32_t> bundle;
    Span<const double> position;    // [I * 3]
    Span<const double> quaternion;  // [I * 4] w x y z, of any length but zero
    Span<const double> scale;
    Span<const InstanceFactors> factors;  // empty where all are 1
    // [S] clusters
    Span<const int32_t> instance;
    Span<const int64_t> first_row;  // row in the bundle
    Span<const int64_t> offset;     // [S + 1] first row in the result, ascending from 0
    Span<const float> weight;       // [S] factors of opacities; empty if all are 1
};

// Writes the gaussians of all clusters in world coordinates, in order. Spherical
// harmonics are rotated into the world and multiplied by the tint, which is exact;
// coefficients that a bundle does not have are 0. Results are computed in double
// precision; the CPU and CUDA give the same bits.
namespace cpu { void gather(const GatherInput& in, const GaussianRows<float>& out); }
// The rows of bundles and `out` are on the device, all other arrays on the host. Work
// is queued on the stream. Throws std::runtime_error if CUDA reports an error.
namespace cuda {
void gather(const GatherInput& in, const GaussianRows<float>& out, Stream stream);
}

}  // namespace v3dg
