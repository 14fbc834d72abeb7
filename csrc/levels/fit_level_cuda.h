#pragma once

// Fits all groups of a level on CUDA.

#include "base/stream.h"
#include "fit_group/fit_group.h"
#include "math/gaussian.h"

namespace v3dg {
namespace cuda {

// The gaussians that the target pictures show, in device memory.
struct DeviceFitTarget {
    GaussianRows<const float> rows;
    float filter_px2;
    bool antialiased;
};

// Like v3dg::fit_level(), but with rows on the device and `error` in host memory.
// Returns when the fit is finished.
//
// Every run on the same device gives the same bits. The number of groups and the device
// determine how many blocks fit a group, but not the order of additions. Different
// devices may use different kernels, which may round differently. Target pictures are
// drawn before the fit, for as many groups at once as memory allows.
void fit_level(const FitConfig& config, Span<const FitGroup> groups, const DeviceFitTarget& target,
               const GaussianRows<float>& rows, float* error, FitProgress& progress, Stream stream);

}  // namespace cuda
}  // namespace v3dg
