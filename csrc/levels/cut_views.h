#pragma once

#include <cstdint>
#include <vector>

#include "camera/camera.h"
#include "math/gaussian.h"
#include "residency/cluster_table.h"

namespace v3dg {

double median(std::vector<double> values);

// The ball around the median of means that holds this share of them; the rest may float far away.
struct Surroundings {
    double center[3], radius;
};
Surroundings surroundings_of(Span<const float> means, double share);

// Looks at the centre of the ball from so many radii away, outwards; what is right in its picture
// is a unit vector, too. Its pixels are left to the caller.
Camera camera_at(const Surroundings& ball, double distance, const double outwards[3],
                 const double right[3]);

// A window of a picture of a cut, and the clusters that it shows. The asset is drawn `samples`
// times as large.
struct CutView {
    Camera camera;
    std::vector<int32_t> clusters;
    int samples;
};

// Pictures of cuts of one bundle: of random budgets, at random sizes, from random sides of what
// lies around a centre, or from cameras that are given.
struct CutPictures {
    const ClusterTable& table;
    Span<const float> means;  // [N * 3] of the asset
    Span<const Camera> cameras;
    uint64_t seed;
    double most, least;  // gaussians of a cut
    std::vector<double>
        weight;         // [N] how often each of the asset is looked at, as the sum up to it
    Surroundings ball;  // that is looked at
};

// Those of a bundle and its asset, which has gaussians: of cuts of 0.7 of these down to the
// coarsest one. Borrows all but the seed.
CutPictures pictures_of_cuts(const ClusterTable& table, const GaussianRows<const float>& asset,
                             Span<const Camera> cameras, uint64_t seed);

// Picture number `number`. The same arguments give the same view. A cut from a given camera has the
// share of the gaussians in its frustum, and is as large, that a cut from around has of all.
CutView cut_view(const CutPictures& pictures, uint64_t number);

}  // namespace v3dg
