#pragma once

#include "fit_group/fit_group.h"

namespace v3dg {

// Fits all groups of one level, each on one thread; the result does not depend on how many there
// are. `error` is (groups, 2). Returns early, rows half done, once `progress.cancel` is set.
void fit_level(const FitConfig& config, Span<const FitGroup> groups, const FitTarget& target,
               const GaussianRows<float>& rows, float* error, FitProgress& progress);

}  // namespace v3dg
