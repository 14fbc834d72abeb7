#pragma once

#include "fit_group/fit_group.h"
#include "levels/cut_views.h"

namespace v3dg {

// Gaussians of the clusters of a bundle, of all levels.
struct CutRows {
    GaussianRows<float> rows;
    Span<const float> radius;  // a length for each gaussian, which no scale outgrows
};

// Moves gaussians until pictures of cuts are those of the target: config.steps of Adam, each of the
// gaussians that one picture shows. The first `target_count` of them, level 0, are the target's,
// and stay. A group is fitted alone, seen from all sides at one size (fit_level.h); here it is seen
// as a cut shows it: next to groups of its own level and of others, which hide parts of it, at the
// sizes of the pictures.
//
// Cuts are drawn with the filter of `config`, level 0 too, which shows without one: where pictures
// are small that is a third of what cuts are off. The target's pictures are drawn larger and
// box-averaged. The loss is that of the fit without D-SSIM; positions move in steps of a part of
// the radius. Of `config`, sizes, samples and numbers of its own views are not looked at. The
// result does not depend on the number of threads. Returns early once `progress.cancel` is set;
// `progress.groups_done` counts pictures.
void refine_cuts(const FitConfig& config, const FitTarget& target, uint64_t target_count,
                 const CutRows& levels, const CutPictures& pictures, FitProgress& progress);

// How much is seen of gaussians, one element for each.
struct SeenOfGaussians {
    Span<double> weight;      // blend weights, in parts of the pixels of each picture, added up
    Span<int32_t> num_looks;  // pictures whose cuts have it, whether it shows or not
};

// Adds what config.steps pictures of cuts, drawn as refine_cuts draws them, show of each gaussian.
void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& rows,
                const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress);

}  // namespace v3dg
