#pragma once

// Computes which tiles a record may touch in one row of tiles.

#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// The tiles that a record's ellipse may reach in one row: columns [first, first +
// count).
struct TileRun {
    int row, first, count;
};

// Returns the tiles that a record may reach in one row of tiles. `row` is counted from
// the first row of tiles of the record's box. Nothing is rounded to pixel centres, so
// the result may contain extra tiles, which only cost list entries. If any number is
// NaN, the result has all columns of the box. Counting and scattering agree, because
// both call this function.
V3DG_HD inline TileRun tile_run(const Record<float>& r, int row) {
    row += r.y0 / kFrameTileHeight;
    const int top = max_of(static_cast<int>(r.y0), row * kFrameTileHeight);
    const int bottom =
        min_of(static_cast<int>(r.y1), row * kFrameTileHeight + kFrameTileHeight - 1);
    const EllipseRows<float> ellipse = ellipse_rows(r.l11, r.l12, r.l22, r.log2_opacity);
    float low, high;
    row_extent(ellipse, static_cast<float>(top) + 0.5f - r.v,
               static_cast<float>(bottom) + 0.5f - r.v, low, high);
    // Compute the pixels whose centres are inside the ellipse's extent, clipped to the
    // box.
    const float x0 = r.u + low - 0.5f, x1 = r.u + high - 0.5f;
    const int first = x0 > static_cast<float>(r.x0) ? static_cast<int>(min_of(x0, 65536.0f)) : r.x0;
    const int last = x1 < static_cast<float>(r.x1) ? static_cast<int>(max_of(x1, -1.0f)) : r.x1;
    if (first > last || x1 < 0.0f) return {row, 0, 0};
    return {row, first / kFrameTileWidth, last / kFrameTileWidth - first / kFrameTileWidth + 1};
}

}  // namespace cuda
}  // namespace v3dg
