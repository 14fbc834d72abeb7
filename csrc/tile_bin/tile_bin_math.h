#pragma once

// Which tiles of a picture a record may touch. Tiles are numbered through a batch, row by row.

#include "pipeline/frame_types.h"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {

// A record over more tiles than this is looked at row by row of tiles.
constexpr unsigned kFewTiles = 4;

// The tiles that a record's blocks lie in.
struct TileBox {
    int left, top;
    uint32_t columns, count;

    // Column and row of tile k of at most kFewTiles: with more than two columns there is one row.
    V3DG_HD int column(uint32_t k) const {
        return left + static_cast<int>(columns > 2 ? k : columns == 2 ? k & 1 : 0);
    }
    V3DG_HD int row(uint32_t k) const {
        return top + static_cast<int>(columns > 2 ? 0 : columns == 2 ? k >> 1 : k);
    }
};

V3DG_HD inline TileBox tile_box(const EntryBox& b) {
    constexpr int kColumns = kFrameTileWidth / kEntryBlockSize, kRows = kFrameTileHeight / kEntryBlockSize;
    const int left = b.x0 / kColumns, top = b.y0 / kRows;
    const uint32_t columns = b.x1 / kColumns - left + 1, rows = b.y1 / kRows - top + 1;
    return {left, top, columns, columns * rows};
}

// A record over few tiles as the scattering kernel reads it: depth, and the blocks' first and how many
// follow.
using FewTiles = unsigned long long;
constexpr FewTiles kManyTiles = ~FewTiles(0);

V3DG_HD inline FewTiles few_tiles(uint32_t depth, const EntryBox& b) {
    return FewTiles(depth) << 38 | FewTiles(b.x0) << 24 | FewTiles(b.x1 - b.x0) << 19 | FewTiles(b.y0) << 5 |
           FewTiles(b.y1 - b.y0);
}
V3DG_HD inline uint32_t depth_of(FewTiles f) { return static_cast<uint32_t>(f >> 38); }
V3DG_HD inline EntryBox box_of(FewTiles f) {
    const int x0 = static_cast<int>(f >> 24) & 0x3fff, y0 = static_cast<int>(f >> 5) & 0x3fff;
    return {x0, x0 + (static_cast<int>(f >> 19) & 31), y0, y0 + (static_cast<int>(f) & 31)};
}

// The tiles in one row of tiles that a record's ellipse may reach: columns [first, first + count).
struct TileRun {
    int row, first, count;
};

// `row` counts from the record's first row of tiles.
V3DG_HD inline TileRun tile_run(const Record<float>& r, int row) {
    row += r.y0 / kFrameTileHeight;
    const int top = max_of(static_cast<int>(r.y0), row * kFrameTileHeight);
    const int bottom = min_of(static_cast<int>(r.y1), row * kFrameTileHeight + kFrameTileHeight - 1);
    const EllipseRows<float> ellipse = ellipse_rows(r.l11, r.l12, r.l22, r.log2_opacity);
    float low, high;
    row_extent(ellipse, static_cast<float>(top) + 0.5f - r.v, static_cast<float>(bottom) + 0.5f - r.v, low,
               high);
    // Pixels whose centres lie in between, cut to the box; written so that NaN keeps the box.
    const float x0 = r.u + low - 0.5f, x1 = r.u + high - 0.5f;
    const int first = x0 > static_cast<float>(r.x0) ? static_cast<int>(min_of(x0, 65536.0f)) : r.x0;
    const int last = x1 < static_cast<float>(r.x1) ? static_cast<int>(max_of(x1, -1.0f)) : r.x1;
    if (first > last || x1 < 0.0f) return {row, 0, 0};
    return {row, first / kFrameTileWidth, last / kFrameTileWidth - first / kFrameTileWidth + 1};
}

}  // namespace cuda
}  // namespace v3dg
