#pragma once

#include "base/device.h"
#include "tile_bin/tile_bin_math.h"

namespace v3dg {
namespace cuda {

// A record over more than kFewTiles tiles. They come in batches of kLargeAtOnce of one item, so of neighbours
// in one picture; what a batch lacks is filled up at its end.
struct LargeRecord {
    uint32_t record, image;  // kNoRecord where there is none
};
constexpr unsigned kLargeAtOnce = 16;
constexpr uint32_t kNoRecord = ~0u;

// The records of an item, and the tiles of their picture.
struct ItemTiles {
    uint32_t num_records, record, first_tile, columns;
};

// What project() has found out of the tiles, and scratch of tile_bin(). Cleared before project().
struct TileCounts {
    uint32_t* count;  // [num_tiles] of the records over at most kFewTiles; zero after tile_bin()
    unsigned long long* num_large;  // whole batches
    unsigned* ticket;
    unsigned long long* state;  // [tile_bin_parts(num_tiles)]
};
size_t tile_bin_parts(size_t num_tiles);

// Puts a frame's records into the lists of the tiles that they may touch.
struct TileBinInput {
    const ItemTiles* items;
    const FewTiles* few;  // of each record, or kManyTiles where it is in `large`
    const Record<float>* records;
    const FrameImage* images;
    uint32_t num_images, num_tiles;
    unsigned long long item_capacity, record_capacity, large_capacity, entry_capacity;
    const LargeRecord* large;
    TileCounts counts;
    FrameCounters* counters;  // sets `entries`, past the capacity also where `large` had too little room
};

struct TileBinOutput {
    unsigned long long* tile_first;  // [num_tiles + 1]
    uint32_t* image_of_tile;
    TileEntry* entries;
};

void tile_bin(const TileBinInput& in, const TileBinOutput& out, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
