#pragma once

// Chooses pictures of random cuts of a bundle. Refinement compares them with pictures
// of the asset.

#include <cstdint>
#include <vector>

#include "camera/camera.h"
#include "math/gaussian.h"
#include "residency/cluster_table.h"
#include "select/instance_view.h"
#include "select/rule.h"

namespace v3dg {

double median(std::vector<double> values);

// A ball around the median of the means. It contains a given fraction of the means; the
// others may be far away.
struct Surroundings {
    double center[3], radius;
};
Surroundings surroundings_of(Span<const float> means, double share);

// Returns a camera that looks at the centre of the ball, at a distance of `distance`
// radii in the direction `outwards`. `right` is the direction to the right in its
// picture. Both directions are unit vectors.
Camera camera_at(const Surroundings& ball, double distance, const double outwards[3],
                 const double right[3], const Pinhole<double>& projection);

// A picture of the asset, and its window in which cuts are compared. For the
// comparison, the asset is drawn with `samples` x `samples` samples per pixel.
struct AssetView {
    Camera picture, window;
    int samples;
    double share;          // fraction of the picture's gaussians that are in the first cut
    double size;           // size of the picture, relative to the asset's native size
    double num_gaussians;  // number of gaussians in the picture, all of them of level 0
};

// Describes pictures of cuts of one bundle. Budgets and sizes are random. Cameras are
// given, or look at a centre from random directions.
struct CutPictures {
    const ClusterTable& table;
    Span<const float> means;  // [N * 3] means of the asset's gaussians
    Span<const Camera> cameras;
    uint64_t seed;
    double most, least;  // bounds on the number of gaussians in a cut
    std::vector<double>
        // [N] prefix sums of the probabilities of a window around each gaussian
        weight;
    Surroundings ball;  // the ball that views look at
};

// Returns the description of the pictures of a bundle and its asset, which must not be
// empty. The largest cuts have 0.7 times the asset's gaussians, and the smallest are
// the coarsest cut. The result points to the arguments, except for the seed.
CutPictures pictures_of_cuts(const ClusterTable& table, const GaussianRows<const float>& asset,
                             Span<const Camera> cameras, uint64_t seed);

// Returns view `number`, which depends only on the arguments. With given cameras, the
// share and the size refer to the gaussians in the camera's frustum. Without them, they
// refer to all gaussians.
AssetView asset_view(const CutPictures& pictures, uint64_t number);

// Returns the rules of cuts 0 to count - 1 of a view. For any `count`, every share of
// the gaussians occurs equally often at every size, over all views.
std::vector<SelectRule> cuts_of_view(const CutPictures& pictures, const AssetView& view,
                                     uint64_t number, size_t count);

// Returns the clusters of a cut that are inside the view's window.
std::vector<int32_t> clusters_in_window(const CutPictures& pictures, const AssetView& view,
                                        const SelectRule& rule);

// Returns the camera of a window in the coordinates of the bundle, for selection.
InstanceView view_of_window(const ClusterTable& table, const Camera& window);

// One window of a refinement: cut `cut` of view `view`. A view occupies a slot from its
// first to its last cut.
struct PlannedWindow {
    uint64_t view;
    size_t slot;
    size_t cut;
    bool is_new;  // whether this is the view's first window
};

constexpr size_t kWidestWindowPx = 512;

// Number of views whose targets are in memory at the same time; a target has up to 4
// MB. With more views, consecutive steps would share views less often, and memory use
// would grow.
constexpr size_t kViewSlots = 128;

// Returns the plan of window `number`. Consecutive windows use consecutive slots. A
// view is compared with `cuts_per_view` cuts, one in each round over all slots, and is
// then replaced. Views of the first round have fewer cuts, so that each step has the
// same number of new views.
inline PlannedWindow planned_window(uint64_t number, size_t cuts_per_view) {
    const auto slot = static_cast<size_t>(number % kViewSlots);
    const uint64_t round = number / kViewSlots;
    const uint64_t turn = round + slot % cuts_per_view;
    const auto cut = static_cast<size_t>(turn % cuts_per_view);
    return {.view = turn / cuts_per_view * kViewSlots + slot,
            .slot = slot,
            .cut = cut,
            .is_new = round == 0 || cut == 0};
}

}  // namespace v3dg
