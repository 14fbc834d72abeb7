#pragma once

// Refines all levels of a bundle together on CUDA.

#include "levels/fit_level_cuda.h"
#include "levels/refine_cuts.h"

namespace v3dg {
namespace cuda {

// Like v3dg::refine_cuts(), but with rows on the device and all other data in host
// memory. Returns when the refinement is finished. Every run gives the same bits.
void refine_cuts(const FitConfig& config, const CutComparison& comparison,
                 const DeviceFitTarget& target, const CutRows& levels, const CutPictures& pictures,
                 FitProgress& progress, Stream stream);

// Like v3dg::weigh_cuts(), but with rows on the device and all other data in host
// memory. Returns when the weights are computed.
void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& rows,
                const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress,
                Stream stream);

}  // namespace cuda
}  // namespace v3dg
