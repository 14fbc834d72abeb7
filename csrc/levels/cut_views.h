#pragma once

// Pictures of random cuts of a bundle, which refinement compares with those of the asset.

#include <cstdint>
#include <vector>

#include "camera/camera.h"
#include "math/gaussian.h"
#include "residency/cluster_table.h"

namespace v3dg {

double median(std::vector<double> values);

// The ball around the median of means that contains a share of them; the rest may float far away.
struct Surroundings {
    double center[3], radius;
};
Surroundings surroundings_of(Span<const float> means, double share);

// Returns a camera that looks at the centre of the ball from `distance` radii away, in the
// direction `outwards`. `right` is to the right in its picture; both are unit vectors. The caller
// sets its pixels.
Camera camera_at(const Surroundings& ball, double distance, const double outwards[3],
                 const double right[3]);

// A window of a picture of a cut, and the clusters that it shows. The asset is drawn `samples`
// times as large.
struct CutView {
    Camera camera;
    std::vector<int32_t> clusters;
    int samples;
};

// Pictures of cuts of one bundle: of random budgets, at random sizes, from random directions around
// a centre, or from given cameras.
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

// Returns the pictures of a bundle and its asset, which must have gaussians: of cuts from 0.7 of
// these down to the coarsest one. Borrows all arguments but the seed.
CutPictures pictures_of_cuts(const ClusterTable& table, const GaussianRows<const float>& asset,
                             Span<const Camera> cameras, uint64_t seed);

// Returns the view of picture `number`. The same arguments give the same view. A cut from a given
// camera has the share of the gaussians in its frustum, and the size, that a cut from around has of
// all gaussians.
CutView cut_view(const CutPictures& pictures, uint64_t number);

}  // namespace v3dg
