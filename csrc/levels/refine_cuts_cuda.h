#pragma once

// Refines all levels of a bundle together on CUDA.

#include "levels/fit_level_cuda.h"
#include "levels/refine_cuts.h"

namespace v3dg {
namespace cuda {

// As v3dg::refine_cuts, with rows on the device and all else on the host. Returns when
// all is done. Every run gives the same bytes.
void refine_cuts(const FitConfig& config, const CutComparison& comparison,
                 const DeviceFitTarget& target, const CutRows& levels, const CutPictures& pictures,
                 FitProgress& progress, Stream stream);

// As v3dg::weigh_cuts, with rows on the device and all else on the host. Returns when
// all is done.
void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& rows,
                const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress,
                Stream stream);

}  // namespace cuda
}  // namespace v3dg
