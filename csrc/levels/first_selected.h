#pragma once

// Finds the size at which each group of level 1 of a smooth asset is no worse than its
// leaves.

#include <cstdint>
#include <vector>

#include "base/span.h"
#include "camera/camera.h"
#include "levels/cut_views.h"
#include "math/bounds.h"

namespace v3dg {

// Compares pictures of the whole asset, because pictures of single groups show edges
// that other groups hide. The caller draws the pictures, adds their losses, and
// requests the result.
class FirstSelected {
  public:
    static constexpr size_t kSides = 8, kSizes = 4;
    static constexpr int kSamples = 2;  // samples per side of a pixel of the truth

    // Takes the leaves' means, (N, 3), and the groups' balls; `group_offset` has the
    // ranges of the groups' gaussians in level 1.
    FirstSelected(Span<const float> means, Span<const Ball> balls,
                  Span<const int64_t> group_offset);

    static constexpr size_t num_pictures() { return kSides * kSizes; }
    Camera camera(size_t picture) const;

    // Adds the losses that a picture assigns to the leaves: rows of three, of which the
    // third is unused.
    void add(size_t picture, Span<const float> shares, Span<const int64_t> leaf_offset);

    // Returns the factor by which each ball has to grow.
    std::vector<float> growth() const;

  private:
    Surroundings around_;
    std::vector<double> footprint_;  // px² per gaussian of a group at a focal length of 1
    double focal_[kSizes];           // px
    std::vector<double> of_leaves_[kSizes], of_level_[kSizes];  // losses of groups
};

// A picture's colours, (height, width, 3), over white.
struct PictureColors {
    Span<const float> of_leaves, of_level;
    Span<const float> truth;  // kSamples times as wide and high
};

// Computes the error of each pixel, (height, width, 3): of the leaves, of the level,
// and 0.
void losses_of_pixels(const PictureColors& colors, size_t width, size_t height, Span<float> losses);

}  // namespace v3dg
