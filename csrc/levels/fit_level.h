#pragma once

// Fits all groups of a level on the CPU.

#include "fit_group/fit_group.h"

namespace v3dg {

// Fits all groups of one level, each on one thread. The result does not depend on the
// number of threads. `error` is (groups, 2). If `progress.cancel` becomes true, the
// function returns early, and leaves some rows as they were.
void fit_level(const FitConfig& config, Span<const FitGroup> groups, const FitTarget& target,
               const GaussianRows<float>& rows, float* error, FitProgress& progress);

}  // namespace v3dg
