#pragma once

// For each group of level 1 of a smooth asset, finds the smallest size at which its
// gaussians look as good as its leaves.

#include <cstdint>
#include <vector>

#include "base/span.h"
#include "camera/camera.h"
#include "levels/cut_views.h"
#include "math/bounds.h"

namespace v3dg {

// Compares pictures of the leaves and of level 1 with a more exact picture. The
// pictures show the whole asset, because pictures of single groups would show edges
// that other groups hide. The caller draws the pictures, passes the losses to add(),
// and then calls growth().
class FirstSelected {
  public:
    static constexpr size_t kSides = 8, kSizes = 4;
    static constexpr int kSamples = 2;  // samples per pixel side of the exact picture

    // `means` has the means of the leaves, (N, 3), and `balls` the balls of the groups.
    // `group_offset` has the range of each group's gaussians in level 1.
    FirstSelected(Span<const float> means, Span<const Ball> balls,
                  Span<const int64_t> group_offset);

    static constexpr size_t num_pictures() { return kSides * kSizes; }
    Camera camera(size_t picture) const;

    // Adds the losses of one picture, distributed over the leaves. `shares` is (N, 3)
    // with the columns: loss of the leaves, loss of level 1, unused.
    void add(size_t picture, Span<const float> shares, Span<const int64_t> leaf_offset);

    // Returns the factor by which each group's ball must grow.
    std::vector<float> growth() const;

  private:
    Surroundings around_;
    // For each group, the px² per gaussian at a focal length of 1 px.
    std::vector<double> footprint_;
    double focal_[kSizes];  // focal length, px, of the pictures of each size
    // The sum of losses over all pictures, for each size and group.
    std::vector<double> of_leaves_[kSizes], of_level_[kSizes];
};

// Colours of pictures on white, (height, width, 3).
struct PictureColors {
    Span<const float> of_leaves, of_level;
    Span<const float> truth;  // kSamples times as wide and as high as the other
                              // pictures
};

// Computes the loss of each pixel, (height, width, 3), with the channels: loss of the
// leaves, loss of level 1, 0.
void losses_of_pixels(const PictureColors& colors, size_t width, size_t height, Span<float> losses);

}  // namespace v3dg
