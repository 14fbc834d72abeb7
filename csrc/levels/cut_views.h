#pragma once

// Pictures of random cuts of a bundle, which refinement compares with those of the
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

// The ball around the median of means that contains a share of them; the rest may float
// far away.
struct Surroundings {
    double center[3], radius;
};
Surroundings surroundings_of(Span<const float> means, double share);

// Returns a camera that looks at the centre of the ball from `distance` radii away, in
// the direction `outwards`. `right` is to the right in its picture; both are unit
// vectors.
Camera camera_at(const Surroundings& ball, double distance, const double outwards[3],
                 const double right[3], const Pinhole<double>& projection);

// A picture of the asset, and the window of it in which cuts are compared. The asset is
// drawn `samples` times as large.
struct AssetView {
    Camera picture, window;
    int samples;
    double share;          // share of the picture's gaussians in its first cut
    double size;           // side of the picture, relative to the native size of the asset
    double num_gaussians;  // in the picture without levels
};

// Pictures of cuts of one bundle: of random budgets, at random sizes, from random
// directions around a centre, or from given cameras.
struct CutPictures {
    const ClusterTable& table;
    Span<const float> means;  // [N * 3] means of the asset
    Span<const Camera> cameras;
    uint64_t seed;
    double most, least;  // limits of the gaussians of a cut
    std::vector<double>
        weight;         // [N] prefix sums of how often each gaussian of the asset is looked at
    Surroundings ball;  // the ball that views look at
};

// Returns the pictures of a bundle and its asset, which must have gaussians: of cuts
// from 0.7 of these down to the coarsest one. Borrows all arguments but the seed.
CutPictures pictures_of_cuts(const ClusterTable& table, const GaussianRows<const float>& asset,
                             Span<const Camera> cameras, uint64_t seed);

// Returns view `number`. The same arguments give the same view. A cut from a given
// camera has the share of the gaussians in its frustum, and the size, that a cut from
// around has of all gaussians.
AssetView asset_view(const CutPictures& pictures, uint64_t number);

// Returns the rules of cuts 0 to count - 1 of a view, for its window. Together with the
// views they have every share of the gaussians at every size equally often, whatever
// the count is.
std::vector<SelectRule> cuts_of_view(const CutPictures& pictures, const AssetView& view,
                                     uint64_t number, size_t count);

// Returns the clusters of a cut that the window shows.
std::vector<int32_t> clusters_in_window(const CutPictures& pictures, const AssetView& view,
                                        const SelectRule& rule);

// Returns what selection asks of the window, in the frame of the bundle.
InstanceView view_of_window(const ClusterTable& table, const Camera& window);

// A window of a refinement: cut `cut` of view `view`, which has a slot to itself until
// its last cut.
struct PlannedWindow {
    uint64_t view;
    size_t slot;
    size_t cut;
    bool is_new;  // whether the view is the slot's first, or follows another one
};

constexpr size_t kWidestWindowPx = 512;

// The number of views whose targets are in memory together. More would make a rare view
// rarer among neighbouring steps, and take more memory: at most 4 MB each.
constexpr size_t kViewSlots = 128;

// Returns the plan of window `number`. A view is compared with `cuts_per_view` cuts,
// one in each round of the slots; views are replaced in turn, so that each step has as
// many new ones. The first views have fewer cuts.
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
