#pragma once

// Draws the picture of a group on the CPU. It sorts the gaussians by depth, and blends
// them over the tiles of a square.

#include "fit_group/fit_group.h"
#include "project/project.h"
#include "rasterize/simd_blend.h"
#include "tile_bin/tile_bin.h"

namespace v3dg {
namespace V3DG_ISA {

constexpr int kPlanes = 4;  // red, green, blue, alpha

static V3DG_INLINE Window square(int size) { return {0, 0, size, size}; }
static int tiles_across(const FitView& view) { return (view.size + kTileSize - 1) / kTileSize; }

// Projects the gaussians of a draw, and sorts the visible ones by depth. Returns their
// number.
static size_t project_sorted(const Draw<float>& draw, const Pinhole<float>& camera,
                             FitScratch& scratch) {
    Record<float>* records = scratch.records.reserve(draw.count);
    uint32_t* source = scratch.source.reserve(draw.count);
    const Window all = square(static_cast<int>(camera.width));
    Reach unused;
    const size_t count =
        project<float>(draw, 0, draw.count, intrinsics_of(camera), all, records, source, 0, unused);
    uint64_t* order = scratch.order.reserve(count);
    scratch.format = EntryFormat::of(count, 0, INT32_MAX);
    for (size_t i = 0; i < count; ++i)
        order[i] = scratch.format.entry(depth_bits_of(records[i].depth), i, 0);
    sort_tile(records, scratch.format, order, count, scratch.order_scratch.reserve(count));
    return count;
}

static bool misses_tile(const Record<float>& g, int left, int top) {
    return g.x1 < left || g.y1 < top || g.x0 >= left + kTileSize || g.y0 >= top + kTileSize;
}

// Blends records in the sequence given by `order`.
static void blend_sorted(const FitScratch& scratch, const uint64_t* order, size_t count, int left,
                         int top, int size, TilePlanes<float>& tile) {
    blend_tile<float, Extra::kNothing>(
        count, left, top, square(size), StopsBefore{}, tile, [&](size_t i) {
            const Record<float>& g = scratch.records.data()[scratch.format.record_of(order[i])];
            return Listed<float>{&g, misses_tile(g, left, top) ? 0 : blocks_of(g, left, top)};
        });
}

static int place_in_tile(int x, int y) {
    return (y / kBlockSize * kTileBlocks + x / kBlockSize) * kBlockPixels +
           y % kBlockSize * kBlockSize + x % kBlockSize;
}

}  // namespace V3DG_ISA
}  // namespace v3dg
