#pragma once

// Warps that count into tiles. Neighbouring gaussians mostly lie in the same tile, so lanes with one tile go
// there together.

#include "base/launch.cuh"
#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// Adds one to count[tile] for every lane that has one; for a whole warp.
__device__ inline void count_tile(uint32_t* count, uint32_t tile) {
    const unsigned peers = __match_any_sync(kAllLanes, tile);
    if (tile != kNoTile && threadIdx.x % 32 + 1 == unsigned(__ffs(peers)))
        atomicAdd(count + tile, unsigned(__popc(peers)));
}

}  // namespace cuda
}  // namespace v3dg
