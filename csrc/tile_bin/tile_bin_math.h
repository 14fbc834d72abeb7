#pragma once

// Which tiles of a picture a record may touch. Tiles are numbered through a batch, row by row.

#include "pipeline/frame_types.h"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {

// A record over more tiles than this is looked at row by row of tiles.
constexpr unsigned kFewTiles = 4;

// The tiles that the record's pixels lie in.
struct TileBox {
    uint32_t first, columns, count, stride;
    // Tile k of at most kFewTiles: with more than two columns there is one row.
    V3DG_HD uint32_t tile(uint32_t k) const {
        if (columns > 2) return first + k;
        return columns == 1 ? first + k * stride : first + (k >> 1) * stride + (k & 1);
    }
};

V3DG_HD inline TileBox tile_box(const Record<float>& r, const FrameImage& image) {
    const uint32_t left = r.x0 / kFrameTileWidth, top = r.y0 / kFrameTileHeight;
    const uint32_t columns = r.x1 / kFrameTileWidth - left + 1, rows = r.y1 / kFrameTileHeight - top + 1;
    const uint32_t stride = static_cast<uint32_t>(image.tile_columns);
    return {image.first_tile + top * stride + left, columns, columns * rows, stride};
}

// The tiles in one row of tiles that the record's ellipse may reach: [first, first + count).
struct TileRun {
    uint32_t first, count;
};

// `row` counts from the record's first row of tiles.
V3DG_HD inline TileRun tile_run(const Record<float>& r, const FrameImage& image, uint32_t row) {
    const int tile_row = r.y0 / kFrameTileHeight + static_cast<int>(row);
    const int top = max_of(static_cast<int>(r.y0), tile_row * kFrameTileHeight);
    const int bottom = min_of(static_cast<int>(r.y1), tile_row * kFrameTileHeight + kFrameTileHeight - 1);
    const EllipseRows<float> ellipse = ellipse_rows(r.l11, r.l12, r.l22, r.log2_opacity);
    float low, high;
    row_extent(ellipse, static_cast<float>(top) + 0.5f - r.v, static_cast<float>(bottom) + 0.5f - r.v, low,
               high);
    // Pixels whose centres lie in between, cut to the box; written so that NaN keeps the box.
    const float x0 = r.u + low - 0.5f, x1 = r.u + high - 0.5f;
    const int first = x0 > static_cast<float>(r.x0) ? static_cast<int>(min_of(x0, 65536.0f)) : r.x0;
    const int last = x1 < static_cast<float>(r.x1) ? static_cast<int>(max_of(x1, -1.0f)) : r.x1;
    if (first > last || x1 < 0.0f) return {0, 0};
    const uint32_t c0 = static_cast<uint32_t>(first) / kFrameTileWidth;
    const uint32_t c1 = static_cast<uint32_t>(last) / kFrameTileWidth;
    return {image.first_tile + static_cast<uint32_t>(tile_row * image.tile_columns) + c0, c1 - c0 + 1};
}

}  // namespace cuda
}  // namespace v3dg
