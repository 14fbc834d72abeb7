#pragma once

// False colours for levels, clusters and metrics. The channels are red, green and blue,
// from 0 to 1.

#include <array>
#include <cstddef>

namespace v3dg {

using Rgb = std::array<float, 3>;

// Returns the colour of a level; 0 is the finest. Levels 0 to 8 have distinct hues, and
// levels 9 to 17 have darker hues in between. The sequence then repeats, each time
// closer to white, so that all levels differ.
Rgb level_color(size_t level);

// Returns the colour of a cluster. The hue advances by the golden ratio per cluster,
// and the lightness cycles through three values, so that adjacent clusters differ.
Rgb cluster_color(size_t cluster);

// Returns the colour for a value from 0 to 1 on a scale from dark to bright, with even
// steps in lightness.
constexpr size_t kRampColors = 7;
Rgb ramp_color(float value);

// Returns the colour of a cluster whose metric is `share` times the tolerance. Up to a
// share of `most`, the cluster is fine enough. Above it, pages with finer clusters are
// missing, and the colour shows the ratio.
Rgb missing_color(float share, float most);

}  // namespace v3dg
