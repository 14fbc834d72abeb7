#pragma once

// Refines all levels of a bundle together, by pictures of cuts.

#include "fit_group/fit_group.h"
#include "levels/cut_views.h"

namespace v3dg {

// The gaussians of the clusters of a bundle, of all levels.
struct CutRows {
    GaussianRows<float> rows;
    Span<const float> radius;  // the largest scale of each gaussian
};

// The comparison of pictures in a refinement.
struct CutComparison {
    int windows_per_step;  // windows, 1 to kMostWindows, whose gradients make one step
    int cuts_per_view;     // cuts that each picture of the target is compared with
};
constexpr int kMostWindows = 32;

// Moves gaussians until pictures of cuts match those of the target: there are
// config.steps of Adam, each for the gaussians that the step's windows show
// (cut_views.h). The first `target_count` of them, level 0, are the target's and do not
// move. A fit (fit_level.h) sees each group alone, from all sides at one size; here a
// group is seen in cuts: next to groups of its own level and of others, which hide
// parts of it, at the sizes of the pictures.
//
// Cuts are drawn with the filter of `config`, including level 0, which is drawn without
// one elsewhere: in small pictures that is a third of the error of cuts. The target's
// pictures are drawn larger and box-averaged. The loss is that of the fit without
// D-SSIM; positions move in steps of a part of the radius. The sizes of steps in
// `config` are for gaussians that one window shows. The sizes, samples and numbers of
// views in `config` are ignored. The result does not depend on the number of threads.
// Returns early once `progress.cancel` is set; `progress.groups_done` counts windows.
void refine_cuts(const FitConfig& config, const CutComparison& comparison, const FitTarget& target,
                 uint64_t target_count, const CutRows& levels, const CutPictures& pictures,
                 FitProgress& progress);

// The visibility of each gaussian.
struct SeenOfGaussians {
    Span<double> weight;      // sums of blend weights, as fractions of each picture's pixels
    Span<int32_t> num_looks;  // windows whose cuts contain it, whether it is visible or not
};

// Draws the window of the first cut of each of config.steps views as refine_cuts does,
// and adds how much they show of each gaussian.
void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& rows,
                const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress);

}  // namespace v3dg
