#pragma once

// Pictures of random cuts of a bundle. Refinement compares them with pictures of the
// asset.

#include <cstdint>
#include <vector>

#include "camera/camera.h"
#include "math/gaussian.h"
#include "residency/cluster_table.h"
#include "select/instance_view.h"
#include "select/rule.h"

namespace v3dg {

double median(std::vector<double> values);

// A ball around the median of the means. It contains a given share of the means; the
// other means may be far away.
struct Surroundings {
    double center[3], radius;
};
Surroundings surroundings_of(Span<const float> means, double share);

// Returns a camera that looks at the centre of the ball from `distance` radii away, in
// direction `outwards`. `right` is the direction to the right in its picture. The two
// directions are unit vectors.
Camera camera_at(const Surroundings& ball, double distance, const double outwards[3],
                 const double right[3], const Pinhole<double>& projection);

// A picture of the asset, and the window of it in which cuts are compared. For the
// comparison, the asset is drawn with `samples` x `samples` pixels per pixel.
struct AssetView {
    Camera picture, window;
    int samples;
    double share;          // share of the picture's gaussians in the first cut
    double size;           // side of the picture, relative to the asset's native size
    double num_gaussians;  // number of gaussians in the picture, without levels
};

// Describes pictures of cuts of one bundle. Budgets and sizes are random. Views are
// from random directions around a centre, or from given cameras.
struct CutPictures {
    const ClusterTable& table;
    Span<const float> means;  // [N * 3] means of the asset's gaussians
    Span<const Camera> cameras;
    uint64_t seed;
    double most, least;  // limits of the number of gaussians in a cut
    std::vector<double>
        // [N] prefix sums of the probabilities that a window is around a gaussian
        weight;
    Surroundings ball;  // the ball that views look at
};

// Returns the description of the pictures of a bundle and its asset. The asset must not
// be empty. The largest cuts have 0.7 times the asset's gaussians, the smallest are the
// coarsest cut. The result borrows all arguments except the seed.
CutPictures pictures_of_cuts(const ClusterTable& table, const GaussianRows<const float>& asset,
                             Span<const Camera> cameras, uint64_t seed);

// Returns view `number`, which depends only on the arguments. With given cameras, the
// share and the size refer to the gaussians in the camera's frustum, otherwise to all
// gaussians.
AssetView asset_view(const CutPictures& pictures, uint64_t number);

// Returns the rules of cuts 0 to count - 1 of a view. Over all views, every share of
// the gaussians occurs equally often at every size, for any `count`.
std::vector<SelectRule> cuts_of_view(const CutPictures& pictures, const AssetView& view,
                                     uint64_t number, size_t count);

// Returns the clusters of a cut that are in the view's window.
std::vector<int32_t> clusters_in_window(const CutPictures& pictures, const AssetView& view,
                                        const SelectRule& rule);

// Returns the camera of a window in the coordinates of the bundle, for selection.
InstanceView view_of_window(const ClusterTable& table, const Camera& window);

// A window of a refinement: cut `cut` of view `view`. The view occupies a slot from its
// first to its last cut.
struct PlannedWindow {
    uint64_t view;
    size_t slot;
    size_t cut;
    bool is_new;  // the view is new in the slot
};

constexpr size_t kWidestWindowPx = 512;

// The number of views whose targets are in memory together, up to 4 MB each. With more
// views, consecutive steps would share views more rarely, and use more memory.
constexpr size_t kViewSlots = 128;

// Returns the plan of window `number`. Consecutive windows use consecutive slots. A
// view is compared with `cuts_per_view` cuts, one per round over all slots, and is then
// replaced. The views of the first round have fewer cuts, so that each step has equally
// many new views.
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
