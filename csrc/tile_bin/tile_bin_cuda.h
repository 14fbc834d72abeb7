#pragma once

#include "base/device.h"
#include "frame/draw_list.h"
#include "tile_bin/tile_bin_math.h"

namespace v3dg {
namespace cuda {

// Words of TileCounts::state.
size_t tile_bin_parts(size_t num_tiles);

// Puts a frame's records into the lists of the tiles that they may touch.
struct TileBinInput {
    const ItemTiles* items;
    const FewTiles* few;  // of each record, or kManyTiles where it is in `large`
    RecordPlanes records;
    const FrameImage* images;
    uint32_t num_images, num_tiles;
    Capacity capacity;
    const LargeRecord* large;
    TileCounts counts;
    FrameCounters*
        counters;  // sets `entries`; without the large ones where they had too little room
};

struct TileBinOutput {
    unsigned long long* tile_first;  // [num_tiles + 1]
    uint32_t* image_of_tile;
    TileEntry* entries;
};

void tile_bin(const TileBinInput& in, const TileBinOutput& out, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
