// Count, scan, scatter. Records over few tiles have been counted where they were projected; here those over
// many are, their rows of tiles spread over a warp. Compiled without contraction, so that the counting and
// the scattering kernel see the same ellipse.

#include "tile_bin/tile_bin_cuda.h"

#include <algorithm>

#include "base/scan.cuh"
#include "tile_bin/warp_tiles.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kThreads = 256;

// Calls visit(large record, tile) for the tiles of 32 records, one a lane (`at` >= end: none).
template <class Visit>
__device__ void for_each_large_tile(const TileBinInput& in, unsigned long long at, unsigned long long end,
                                    const Visit& visit) {
    const unsigned lane = threadIdx.x % 32;
    LargeRecord mine{0, 0};
    unsigned rows = 0;
    if (at < end) {
        mine = in.large[at];
        const Record<float>& r = in.records[mine.record];
        rows = r.y1 / kFrameTileHeight - r.y0 / kFrameTileHeight + 1;
    }
    unsigned rows_after = rows;  // of this lane and those before it
#pragma unroll
    for (unsigned offset = 1; offset < 32; offset *= 2) {
        const unsigned below = __shfl_up_sync(kAllLanes, rows_after, offset);
        if (lane >= offset) rows_after += below;
    }
    const unsigned total = __shfl_sync(kAllLanes, rows_after, 31);
    for (unsigned first = 0; first < total; first += 32) {
        // The record of row first + lane: the first one that ends after it.
        const unsigned row = first + lane;
        int owner = 0;
#pragma unroll
        for (int step = 16; step > 0; step /= 2)
            if (__shfl_sync(kAllLanes, rows_after, owner + step - 1) <= row) owner += step;
        owner = min(owner, 31);
        const unsigned row_of_owner =
            row - (__shfl_sync(kAllLanes, rows_after, owner) - __shfl_sync(kAllLanes, rows, owner));
        const LargeRecord large{__shfl_sync(kAllLanes, mine.record, owner),
                                __shfl_sync(kAllLanes, mine.image, owner)};
        if (row >= total) continue;
        const TileRun run = tile_run(in.records[large.record], in.images[large.image], row_of_owner);
        for (uint32_t k = 0; k < run.count; ++k) visit(large, run.first + k);
    }
}

__device__ bool is_complete(const TileBinInput& in) {
    return in.counters->items <= in.item_capacity && in.counters->gaussians <= in.record_capacity &&
           *in.counts.num_large <= in.large_capacity;
}

__global__ void count_large_kernel(TileBinInput in) {
    if (!is_complete(in)) return;
    const unsigned long long end = *in.counts.num_large;
    const unsigned long long stride = static_cast<unsigned long long>(gridDim.x) * kThreads;
    for (unsigned long long first = blockIdx.x * kThreads + threadIdx.x / 32 * 32; first < end;
         first += stride)
        for_each_large_tile(in, first + threadIdx.x % 32, end, [&](const LargeRecord&, uint32_t tile) {
            atomicAdd(in.counts.count + tile, 1u);
        });
}

__device__ uint32_t image_of(const TileBinInput& in, uint32_t tile) {
    uint32_t first = 0, count = in.num_images;  // the last image that begins at the tile or before
    while (count > 1) {
        const uint32_t half = count / 2;
        const bool later = in.images[first + half].first_tile <= tile;
        first += later ? half : 0;
        count = later ? count - half : half;
    }
    return first;
}

// A thread a tile.
__global__ void scan_kernel(TileBinInput in, TileBinOutput out) {
    __shared__ unsigned long long before_block;
    const size_t block = take_ticket(in.counts.ticket);
    const size_t tile = block * kThreads + threadIdx.x;
    unsigned long long total;
    const unsigned long long count = tile < in.num_tiles ? in.counts.count[tile] : 0;
    const unsigned long long before_in_block = block_prefix(count, total);
    if (threadIdx.x < 32) {
        const unsigned long long before = prefix_of_part(in.counts.state, block, total);
        if (threadIdx.x == 0) before_block = before;
    }
    __syncthreads();
    if (tile < in.num_tiles) {
        out.tile_first[tile] = out.cursor[tile] = before_block + before_in_block;
        out.image_of_tile[tile] = image_of(in, static_cast<uint32_t>(tile));
    }
    if (block + 1 == gridDim.x && threadIdx.x == 0) {
        const unsigned long long entries = before_block + total;
        out.tile_first[in.num_tiles] = entries;
        const bool lacks_large = *in.counts.num_large > in.large_capacity;
        in.counters->entries = lacks_large && entries <= in.entry_capacity ? in.entry_capacity + 1 : entries;
    }
}

// Depth and box of a record, which are all that its last 16 bytes hold of it but a colour.
__device__ Record<float> end_of_record(const Record<float>* record) {
    const uint4 end = reinterpret_cast<const uint4*>(record)[2];
    Record<float> r;
    r.depth = __uint_as_float(end.y);
    r.x0 = static_cast<uint16_t>(end.z);
    r.x1 = static_cast<uint16_t>(end.z >> 16);
    r.y0 = static_cast<uint16_t>(end.w);
    r.y1 = static_cast<uint16_t>(end.w >> 16);
    return r;
}

// Blocks take items, a thread a record, and then the records over many tiles.
__global__ void scatter_kernel(TileBinInput in, TileBinOutput out) {
    if (!is_complete(in) || in.counters->entries > in.entry_capacity) return;
    const unsigned long long num_items = in.counters->items;
    for (unsigned long long item = blockIdx.x; item < num_items; item += gridDim.x) {
        const uint32_t num_records = in.item_records[item];
        const uint32_t warp_first = threadIdx.x / 32 * 32;
        if (warp_first >= num_records) continue;
        const FrameImage& image = in.images[in.placements[in.items[item].placement].image];
        const uint32_t record = in.items[item].record + threadIdx.x;
        TileBox box{0, 1, 0, 0};
        Record<float> r;
        if (threadIdx.x < num_records) {
            r = end_of_record(in.records + record);
            box = tile_box(r, image);
            if (box.count > kFewTiles) box.count = 0;
        }
        for (unsigned k = 0; __any_sync(kAllLanes, k < box.count); ++k) {
            const uint32_t tile = k < box.count ? box.tile(k) : kNoTile;
            const unsigned long long place = take_place(out.cursor, tile);
            if (tile != kNoTile) out.entries[place] = tile_entry(r, record, image, tile);
        }
    }
    const unsigned long long num_large = *in.counts.num_large;
    const unsigned long long stride = static_cast<unsigned long long>(gridDim.x) * kThreads;
    for (unsigned long long first = blockIdx.x * kThreads + threadIdx.x / 32 * 32; first < num_large;
         first += stride)
        for_each_large_tile(
            in, first + threadIdx.x % 32, num_large, [&](const LargeRecord& large, uint32_t tile) {
                const unsigned long long place = atomicAdd(out.cursor + tile, 1ull);
                out.entries[place] =
                    tile_entry(in.records[large.record], large.record, in.images[large.image], tile);
            });
}

}  // namespace

size_t tile_bin_parts(size_t num_tiles) { return blocks_for(num_tiles, kThreads); }

void tile_bin(const TileBinInput& in, const TileBinOutput& out, cudaStream_t stream) {
    static_assert(kThreads == kItemSize, "a thread a record of an item");
    const unsigned resident = 8 * num_multiprocessors();
    launch("count_large_kernel", count_large_kernel, resident, kThreads, 0, stream, in);
    launch("scan_kernel", scan_kernel, blocks_for(in.num_tiles, kThreads), kThreads, 0, stream, in, out);
    launch("scatter_kernel", scatter_kernel, resident, kThreads, 0, stream, in, out);
}

}  // namespace cuda
}  // namespace v3dg
