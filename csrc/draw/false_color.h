#pragma once

// Colours that stand for something else: red, green and blue, 0 to 1.

#include <array>
#include <cstddef>

namespace v3dg {

using Rgb = std::array<float, 3>;

// Of levels, from fine to coarse; no two are the same. After nine come the hues between those,
// darker; then both again, ever nearer to white.
Rgb level_color(size_t level);

// Hues a golden ratio apart, so that clusters side by side differ, in three lightnesses.
Rgb cluster_color(size_t cluster);

// From dark to bright, even in lightness, of values 0 to 1.
constexpr size_t kRampColors = 7;
Rgb ramp_color(float value);

// Of a cluster whose metric is so many times the tolerance that is wanted: of the right level up to
// `most`, else as much coarser as pages below it are missing.
Rgb missing_color(float share, float most);

}  // namespace v3dg
