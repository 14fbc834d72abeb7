#pragma once

// Warps that count into tiles. Neighbouring gaussians mostly lie in the same tile, so lanes with one tile go
// there together.

#include "base/launch.cuh"
#include "tile_bin/tile_bin_math.h"

namespace v3dg {
namespace cuda {

constexpr uint32_t kNoTile = 0xffffffffu;

// Adds one to count[tile] for every lane that has one; for a whole warp.
__device__ inline void count_tile(uint32_t* count, uint32_t tile) {
    const unsigned peers = __match_any_sync(kAllLanes, tile);
    if (tile != kNoTile && threadIdx.x % 32 + 1 == unsigned(__ffs(peers)))
        atomicAdd(count + tile, unsigned(__popc(peers)));
}

// The place at cursor[tile] for every lane that has one, and moves the cursors on; for a whole warp.
__device__ inline unsigned long long take_place(unsigned long long* cursor, uint32_t tile) {
    const unsigned lane = threadIdx.x % 32;
    const unsigned peers = __match_any_sync(kAllLanes, tile);
    const int leader = __ffs(peers) - 1;
    unsigned long long first = 0;
    if (tile != kNoTile && lane == unsigned(leader))
        first = atomicAdd(cursor + tile, static_cast<unsigned long long>(__popc(peers)));
    first = __shfl_sync(kAllLanes, first, leader);
    return first + __popc(peers & ((1u << lane) - 1));
}

}  // namespace cuda
}  // namespace v3dg
