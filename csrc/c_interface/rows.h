#pragma once

// Gaussians in memory of the caller.

#include <string>

#include <v3dg.h>
#include "math/gaussian.h"

namespace v3dg {

// Throws Fault unless the caller's arrays have room for this many gaussians.
void check_room(const v3dg_gaussians& out, uint64_t num_gaussians);

// Copies gaussians to the caller's arrays, beginning at row `first`.
void copy_rows(const GaussianRows<const float>& rows, const v3dg_gaussians& out, size_t first);

}  // namespace v3dg
