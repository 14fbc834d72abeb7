#pragma once

// Finds, for each group of level 1 of a smooth asset, the size from which on its
// gaussians look as good as its leaves.

#include <cstdint>
#include <vector>

#include "base/span.h"
#include "camera/camera.h"
#include "levels/cut_views.h"
#include "math/bounds.h"

namespace v3dg {

// Compares pictures of leaves and of level 1 with a more exact picture. The pictures
// show the whole asset, because pictures of single groups show edges that other groups
// hide. The caller draws the pictures, passes the losses to add(), then calls growth().
class FirstSelected {
  public:
    static constexpr size_t kSides = 8, kSizes = 4;
    static constexpr int kSamples = 2;  // samples per pixel side of the exact picture

    // `means` has the means of the leaves, (N, 3). `balls` has the balls of the groups.
    // `group_offset` has the ranges of the groups' gaussians in level 1.
    FirstSelected(Span<const float> means, Span<const Ball> balls,
                  Span<const int64_t> group_offset);

    static constexpr size_t num_pictures() { return kSides * kSizes; }
    Camera camera(size_t picture) const;

    // Adds the losses of one picture, distributed over the leaves. `shares` is (N, 3):
    // the loss of the leaves, the loss of level 1, unused.
    void add(size_t picture, Span<const float> shares, Span<const int64_t> leaf_offset);

    // Returns the factor by which each group's ball must grow.
    std::vector<float> growth() const;

  private:
    Surroundings around_;
    // The px² per gaussian of each group, at a focal length of 1 px.
    std::vector<double> footprint_;
    double focal_[kSizes];  // focal length of the pictures with each size of the asset, px
    // For each size and group: the sum of losses over its pictures.
    std::vector<double> of_leaves_[kSizes], of_level_[kSizes];
};

// The colours of pictures over white, (height, width, 3).
struct PictureColors {
    Span<const float> of_leaves, of_level;
    Span<const float> truth;  // kSamples times as wide and as high
};

// Computes the loss of each pixel: (height, width, 3), with the loss of the leaves, the
// loss of level 1, and 0.
void losses_of_pixels(const PictureColors& colors, size_t width, size_t height, Span<float> losses);

}  // namespace v3dg
