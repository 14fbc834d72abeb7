#pragma once

// Fits all groups of a level on CUDA.

#include "base/stream.h"
#include "fit_group/fit_group.h"
#include "math/gaussian.h"

namespace v3dg {
namespace cuda {

// The gaussians that groups should look like, on the device.
struct DeviceFitTarget {
    GaussianRows<const float> rows;
    float filter_px2;
    bool antialiased;
};

// As v3dg::fit_level, with rows on the device and `error` on the host. Returns when all
// is done.
//
// Every run gives the same bytes. The number of groups and the device decide how a
// group is spread over blocks, which changes no order of additions; still, the kernels
// may round differently, as the CPU does. Groups' pictures are drawn before they are
// fitted, for as many groups at once as there is memory.
void fit_level(const FitConfig& config, Span<const FitGroup> groups, const DeviceFitTarget& target,
               const GaussianRows<float>& rows, float* error, FitProgress& progress, Stream stream);

}  // namespace cuda
}  // namespace v3dg
