#pragma once

// Refines all levels of a bundle together by comparing pictures of cuts with the asset.

#include "fit_group/fit_group.h"
#include "levels/cut_views.h"

namespace v3dg {

// The gaussians of all levels of a bundle.
struct CutRows {
    GaussianRows<float> rows;
    // For each gaussian, the length that steps of its position are relative to. A
    // gaussian with radius 0 does not move.
    Span<const float> radius;
};

// The settings of the comparison of pictures in a refinement.
struct CutComparison {
    // Number of windows whose gradients are added up in one step, from 1 to
    // kMostWindows.
    int windows_per_step;
    int cuts_per_view;  // number of cuts that each picture of the target is compared
                        // with
    // Weight of the absolute mean difference of a window, relative to LossWeights::l1
    // and LossWeights::alpha.
    float window_means;
};
constexpr int kMostWindows = 32;

// Moves gaussians so that pictures of cuts match pictures of the target. There are
// config.steps steps of Adam. Each step moves the gaussians that its windows
// (cut_views.h) show. The first `target_count` gaussians are level 0; they belong to
// the target and do not move.
//
// A fit (fit_level.h) shows each group alone, from all directions, at one size. A
// refinement shows groups in cuts: at several sizes, next to groups of several levels,
// and partly hidden.
//
// All levels are drawn with the filter of `config`, even level 0, which is drawn
// without a filter elsewhere. Without the filter, aliasing would be a third of the
// error of cuts in small pictures. Pictures of the target are drawn larger and
// averaged. The loss is that of a fit without D-SSIM, plus the mean differences of
// windows. Steps of positions are relative to the radius. The step sizes in `config`
// apply to a gaussian that one window shows. The image sizes, supersampling and numbers
// of views in `config` are ignored.
//
// The result does not depend on the number of threads. If `progress.cancel` becomes
// true, the function returns early. `progress.groups_done` counts windows.
void refine_cuts(const FitConfig& config, const CutComparison& comparison, const FitTarget& target,
                 uint64_t target_count, const CutRows& levels, const CutPictures& pictures,
                 FitProgress& progress);

// How much of each gaussian the windows show.
struct SeenOfGaussians {
    // For each gaussian, its blend weights as a fraction of each picture's pixels,
    // summed over pictures.
    Span<double> weight;
    // For each gaussian, the number of windows whose cuts contain it, whether it is
    // visible or not.
    Span<int32_t> num_looks;
};

// Measures how visible gaussians are. Draws the window of the first cut of each of
// config.steps views, as refine_cuts() does, and adds to `seen` how much of each
// gaussian the windows show.
void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& rows,
                const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress);

}  // namespace v3dg
