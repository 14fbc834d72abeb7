#pragma once

// Counts records per tile with whole warps. Adjacent gaussians are mostly in the same
// tile, so lanes with the same tile share one atomic operation.

#include "base/launch.cuh"
#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// Adds one to count[tile] for each lane whose tile is not kNoTile. All lanes of the
// warp must call it.
__device__ inline void count_tile(uint32_t* count, uint32_t tile) {
    const unsigned peers = __match_any_sync(kAllLanes, tile);
    if (tile != kNoTile && threadIdx.x % 32 + 1 == unsigned(__ffs(peers)))
        atomicAdd(count + tile, unsigned(__popc(peers)));
}

// A queue of tiles to count. It receives every tile of a record except the first one. A
// warp counts the queued tiles when there are 32 of them.
struct WaitingTiles {
    uint32_t tile[31 + 32 * (kFewTiles - 1)];
    unsigned count;
};

// Calls add(k, at) for each tile k >= 1 of each lane, where `at` is the tile's index in
// the queue. Adds the number of calls to `num_waiting`. All lanes of the warp must call
// it.
template <class Add>
__device__ void let_wait(unsigned num_tiles, unsigned& num_waiting, const Add& add) {
    const unsigned lane = threadIdx.x % 32;
    for (unsigned k = 1; k < kFewTiles; ++k) {
        const unsigned lanes = __ballot_sync(kAllLanes, num_tiles > k);
        if (lanes == 0) break;
        if (num_tiles > k) add(k, num_waiting + __popc(lanes & ((1u << lane) - 1)));
        num_waiting += __popc(lanes);
    }
}

// Counts the first tile of each lane, and adds the lane's other tiles to the queue.
// Counts the queued tiles when there are 32 of them. All lanes of the warp must call
// it.
template <class TileOf>
__device__ void count_tiles(uint32_t* count, unsigned num_tiles, const TileOf& tile_of,
                            WaitingTiles& waiting) {
    const unsigned lane = threadIdx.x % 32;
    count_tile(count, num_tiles > 0 ? tile_of(0) : kNoTile);
    unsigned num_waiting = waiting.count;
    let_wait(num_tiles, num_waiting,
             [&](unsigned k, unsigned at) { waiting.tile[at] = tile_of(k); });
    __syncwarp();
    for (; num_waiting >= 32; num_waiting -= 32)
        count_tile(count, waiting.tile[num_waiting - 32 + lane]);
    if (lane == 0) waiting.count = num_waiting;
    __syncwarp();
}

// Counts the tiles that remain in the queue. All lanes of the warp must call it once,
// at the end.
__device__ inline void count_waiting(uint32_t* count, const WaitingTiles& waiting) {
    const unsigned lane = threadIdx.x % 32;
    count_tile(count, lane < waiting.count ? waiting.tile[lane] : kNoTile);
}

}  // namespace cuda
}  // namespace v3dg
