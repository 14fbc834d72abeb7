#pragma once

// Copies the gaussians of the clusters of a cut into one array, transformed into the
// world.

#include <cstdint>

#include "base/span.h"
#include "base/stream.h"
#include "math/gaussian.h"
#include "math/instance_factors.h"

namespace v3dg {

// Clusters of instances. An instance transforms a point p to scale * rotation p +
// position.
struct GatherInput {
    Span<const GaussianRows<const float>> bundles;
    // [I] bundle of each instance
    Span<const int32_t> bundle;
    Span<const double> position;    // [I * 3]
    Span<const double> quaternion;  // [I * 4] w x y z, of any nonzero length
    Span<const double> scale;
    Span<const InstanceFactors> factors;  // empty if all are 1
    // [S] instance of each cluster
    Span<const int32_t> instance;
    Span<const int64_t> first_row;  // [S] first row of each cluster in its bundle
    // [S + 1] first row of each cluster in the result, ascending from 0
    Span<const int64_t> offset;
    Span<const float> weight;  // [S] factors of opacities; empty if all are 1
};

// Writes the gaussians of all clusters in world coordinates, in order. SH coefficients
// are rotated into the world and multiplied by the tint, which is exact. Coefficients
// that a bundle does not have become 0. All computations are in double precision, and
// the CPU and CUDA compute the same bits.
namespace cpu { void gather(const GatherInput& in, const GaussianRows<float>& out); }
// The rows of bundles and `out` are on the device, and all other arrays in host memory.
// The work is enqueued on the stream. Throws std::runtime_error if CUDA reports an
// error.
namespace cuda {
void gather(const GatherInput& in, const GaussianRows<float>& out, Stream stream);
}

}  // namespace v3dg
