#pragma once

#include "fit_group/fit_group.h"
#include "math/camera.h"

namespace v3dg {

// A picture of some of the clusters: a cut, or what of it the picture shows.
struct CutView {
    Camera camera;
    Span<const int32_t> clusters;
};

// Gaussians of clusters, of all levels.
struct CutRows {
    GaussianRows<float> rows;
    Span<const int64_t> offset;  // [C + 1] of the clusters in the rows
    Span<const float> radius;    // a length for each gaussian, which no scale outgrows
};

// Moves gaussians until pictures of cuts are those of the target: a step of Adam a view, of the gaussians
// that it shows. The first `target_count` of them, level 0, are the target's, and stay. A group is fitted
// alone, seen from all sides at one size (fit_level.h); here it is seen as a cut shows it: next to groups of
// its own level and of others, which hide parts of it, at the sizes of the views.
//
// Cuts are drawn with the filter of `config`, level 0 too, which shows without one: where pictures are small
// that is a third of what cuts are off. The target's pictures are drawn config.supersample times as large,
// small ones twice that, and box-averaged. The loss is that of the fit without D-SSIM; positions move in
// steps of a part of the radius. Of `config`, sizes and numbers of its own views are not looked at. The
// result does not depend on the number of threads. Returns early once `progress.cancel` is set;
// `progress.groups_done` counts views.
void refine_cuts(const FitConfig& config, const FitTarget& target, uint64_t target_count,
                 const CutRows& levels, Span<const CutView> views, FitProgress& progress);

}  // namespace v3dg
