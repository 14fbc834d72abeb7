#pragma once

#include "base/device.h"
#include "pipeline/frame_types.h"

namespace v3dg {
namespace cuda {

// A record over more than kFewTiles tiles.
struct LargeRecord {
    uint32_t record, image;
};

// What project() has found out of the tiles, and scratch of tile_bin(). Cleared before project().
struct TileCounts {
    uint32_t* count;  // [num_tiles] of the records over at most kFewTiles
    unsigned long long* num_large;
    unsigned* ticket;
    unsigned long long* state;  // [tile_bin_parts(num_tiles)]
};
size_t tile_bin_parts(size_t num_tiles);

// Puts a frame's records into the lists of the tiles that they may touch.
struct TileBinInput {
    const Placement* placements;
    const DrawItem* items;
    const uint32_t* item_records;  // records that each item has
    const Record<float>* records;
    const FrameImage* images;
    uint32_t num_images, num_tiles;
    unsigned long long item_capacity, record_capacity, large_capacity, entry_capacity;
    const LargeRecord* large;
    TileCounts counts;
    FrameCounters* counters;  // sets `entries`, past the capacity also where `large` had too little room
};

// `tile_first` is (num_tiles + 1); `cursor`, scratch, (num_tiles).
struct TileBinOutput {
    unsigned long long *tile_first, *cursor;
    uint32_t* image_of_tile;
    TileEntry* entries;
};

void tile_bin(const TileBinInput& in, const TileBinOutput& out, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
