#pragma once

// Refines all levels of a bundle together, by comparing pictures of cuts with the
// asset.

#include "fit_group/fit_group.h"
#include "levels/cut_views.h"

namespace v3dg {

// The gaussians of all levels of a bundle.
struct CutRows {
    GaussianRows<float> rows;
    // The length that steps of each gaussian's position are relative to. A gaussian with
    // radius 0 does not move.
    Span<const float> radius;
};

// The settings of the comparison of pictures in a refinement.
struct CutComparison {
    // The number of windows whose gradients are added up for one step: 1 to
    // kMostWindows.
    int windows_per_step;
    int cuts_per_view;  // cuts that are compared with each picture of the target
    // Weight of the absolute mean difference of a window, relative to LossWeights::l1
    // and LossWeights::alpha.
    float window_means;
};
constexpr int kMostWindows = 32;

// Moves gaussians so that pictures of cuts match pictures of the target. There are
// config.steps steps of Adam. Each moves the gaussians that the step's windows show
// (cut_views.h). The first `target_count` gaussians are level 0; they belong to the
// target and do not move.
//
// A fit (fit_level.h) sees each group alone, from all sides, at one size. A refinement
// sees groups in cuts: at several sizes, beside groups of several levels, and partly
// hidden.
//
// All levels are drawn with the filter of `config`. This includes level 0, although it
// is drawn without a filter elsewhere; in small pictures, aliasing is a third of the
// error of cuts. Pictures of the target are drawn larger and averaged. The loss is the
// loss of a fit without D-SSIM, and of the mean differences of windows. Steps of
// positions are relative to the radius. The step sizes in `config` are for a gaussian
// that one window shows. The image sizes, supersampling and numbers of views in
// `config` are ignored.
//
// The result does not depend on the number of threads. If `progress.cancel` becomes
// true, it returns early. `progress.groups_done` counts windows.
void refine_cuts(const FitConfig& config, const CutComparison& comparison, const FitTarget& target,
                 uint64_t target_count, const CutRows& levels, const CutPictures& pictures,
                 FitProgress& progress);

// The visibility of each gaussian in windows.
struct SeenOfGaussians {
    // Sum of blend weights, as a fraction of each picture's pixels.
    Span<double> weight;
    // Number of windows whose cuts contain the gaussian, visible or not.
    Span<int32_t> num_looks;
};

// Draws the window of the first cut of each of config.steps views like refine_cuts(),
// and adds to `seen` how much the windows show of each gaussian.
void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& rows,
                const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress);

}  // namespace v3dg
