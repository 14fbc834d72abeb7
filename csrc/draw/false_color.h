#pragma once

// False colours for levels, clusters and metrics: red, green and blue, each from 0 to
// 1.

#include <array>
#include <cstddef>

namespace v3dg {

using Rgb = std::array<float, 3>;

// Returns the colour of a level, counted from the finest; all levels differ. The first
// nine levels have distinct hues, the next nine the hues in between, darker. This
// sequence repeats, each time closer to white.
Rgb level_color(size_t level);

// Returns the colour of a cluster. Hues advance by the golden ratio and lightness
// cycles through three values, so that adjacent clusters differ.
Rgb cluster_color(size_t cluster);

// Returns a colour for a value from 0 to 1, from dark to bright, with even steps in
// lightness.
constexpr size_t kRampColors = 7;
Rgb ramp_color(float value);

// Returns the colour of a cluster whose metric is `share` times the wanted tolerance.
// Up to `most` the cluster has the right level; above, it is too coarse because pages
// below it are missing, and the colour shows by how much.
Rgb missing_color(float share, float most);

}  // namespace v3dg
