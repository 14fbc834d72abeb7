#pragma once

// Large records are projected gaussians that cover many tiles. These functions pass
// them to tile_bin in batches.

#include "frame/tile_list.h"
#include "project/warp_space.cuh"

namespace v3dg {
namespace cuda {

// Divides the rows of tiles of a large record evenly into `count` parts, and returns
// one of them. If the part is empty, its record is kNoRecord.
__device__ inline LargeRecord part_of(LargeRecord large, int part, int count) {
    const int top = large.box.y0 / kFrameTileHeight,
              rows = static_cast<int>(tile_rows_of(large.box));
    const int first = rows * part / count, end = rows * (part + 1) / count;
    if (first == end) large.record = kNoRecord;
    if (first > 0) large.box.y0 = static_cast<uint16_t>((top + first) * kFrameTileHeight);
    if (end < rows) large.box.y1 = static_cast<uint16_t>((top + end) * kFrameTileHeight - 1);
    return large;
}

// Moves the item's large records from the queue to the output, in whole batches. An
// incomplete batch stays in the queue; if `is_end` is set, it is padded and moved. A
// batch that covers very many tiles is divided into several batches, each with a part
// of every record.
template <class Model>
__device__ void write_large(WarpSpace<Model>& space, FrameCounters& counters,
                            const ProjectOutput& out, bool is_end) {
    const unsigned num_large = space.num_large, lane = threadIdx.x % 32;
    const unsigned num_batches =
        is_end ? blocks_for(num_large, kLargeAtOnce) : num_large / kLargeAtOnce;
    if (num_batches == 0) return;
    const unsigned count = num_batches * kLargeAtOnce;
    for (unsigned first = 0; first < count; first += 32) {
        static_assert(kLargeAtOnce == 16, "a half-warp processes one batch");
        const unsigned k = first + lane;
        LargeRecord large{.record = kNoRecord, .image = space.tables.placement.image, .box = {}};
        int tiles = 0;
        if (k < min(num_large, count)) {
            large.record = space.tables.item.record + space.large[k];
            large.box = space.boxes[k];
            tiles = static_cast<int>(num_tiles_of(large.box));
        }
#pragma unroll
        for (unsigned step = 1; step < kLargeAtOnce; step *= 2)
            tiles += __shfl_xor_sync(kAllLanes, tiles, step);
        const unsigned parts = k < count ? (tiles + kMostLargeTiles - 1) / kMostLargeTiles : 0;
        const unsigned of_first = __shfl_sync(kAllLanes, parts, 0),
                       before = lane < 16 ? 0 : of_first;
        unsigned long long place = 0;
        if (lane == 31)
            place = atomicAdd(&counters.large,
                              static_cast<unsigned long long>(kLargeAtOnce * (before + parts)));
        place = __shfl_sync(kAllLanes, place, 31) + kLargeAtOnce * before + lane % kLargeAtOnce;
        for (unsigned part = 0; part < parts; ++part, place += kLargeAtOnce)
            if (place < out.large_capacity)
                out.large[place] =
                    parts == 1 || large.record == kNoRecord ? large : part_of(large, part, parts);
    }
    const unsigned left = num_large - min(count, num_large);
    RecordBox box{};
    uint8_t which = 0;
    if (lane < left) {
        box = space.boxes[count + lane];
        which = space.large[count + lane];
    }
    __syncwarp();
    if (lane < left) {
        space.boxes[lane] = box;
        space.large[lane] = which;
    }
    if (lane == 0) space.num_large = left;
    __syncwarp();
}

}  // namespace cuda
}  // namespace v3dg
