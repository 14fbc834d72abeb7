// Binning on CUDA. It counts the records per tile, scans the counts, and scatters
// entries. project() has already counted the records that touch few tiles. Records that
// touch many tiles (large records) are counted here, and a warp shares their rows of
// tiles. The file is compiled without floating-point contraction, so that counting and
// scattering compute the same ellipses.

#include "tile_bin/tile_bin.h"

#include <algorithm>

#include "base/scan.cuh"
#include "frame/count_tile.cuh"
#include "frame/record.cuh"
#include "tile_bin/tile_bin_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kThreads = 256, kWarps = kThreads / 32;
// Number of resident blocks per multiprocessor with 164 KiB of shared memory.
constexpr unsigned kBlocks = 5;

// The block size, and the blocks per multiprocessor, of count_large_kernel.
constexpr unsigned kCountThreads = 512, kCountBlocks = 3;
// Blocks count in shared memory if there are at least this many large records per tile.
constexpr unsigned kLeastLarge = 16;

// The large records that a warp processes together. Lanes i and i + 16 have the same
// record.
struct LargeBatch {
    uint32_t image;
    uint32_t record;  // index of this lane's record
    RecordBox box;    // pixel box of this lane's record
    int rows;         // tile rows of this lane's record; 0 if there is none
    int rows_after;   // prefix sum: tile rows of all records up to this one
};

// The part of a batch's tile rows that a warp processes. A batch is divided into
// 2^log2_parts parts.
struct LargePart {
    int number, log2_parts;
};

__device__ LargeBatch load_batch(const TileBinInput& in, unsigned long long first) {
    const LargeRecord mine = in.large[first + threadIdx.x % kLargeAtOnce];
    LargeBatch batch{
        .image = mine.image, .record = mine.record, .box = mine.box, .rows = 0, .rows_after = 0};
    if (mine.record != kNoRecord) batch.rows = static_cast<int>(tile_rows_of(mine.box));
    batch.rows_after = warp_prefix<kLargeAtOnce>(batch.rows);
    return batch;
}

// Returns the pixel box of the record in another lane.
__device__ RecordBox box_of_lane(const RecordBox& box, int lane) {
    const uint32_t columns = __shfl_sync(kAllLanes, box.x0 | uint32_t(box.x1) << 16, lane),
                   rows = __shfl_sync(kAllLanes, box.y0 | uint32_t(box.y1) << 16, lane);
    return {static_cast<uint16_t>(columns), static_cast<uint16_t>(columns >> 16),
            static_cast<uint16_t>(rows), static_cast<uint16_t>(rows >> 16)};
}

// Among the lanes 0 to kCount - 1, returns the first whose `number` is above `at`, or
// the last one if there is none. Numbers must not decrease from lane to lane.
template <int kCount>
__device__ int first_lane_above(int number, int at) {
    int lane = 0;
#pragma unroll
    for (int step = kCount / 2; step > 0; step /= 2)
        if (__shfl_sync(kAllLanes, number, lane + step - 1) <= at) lane += step;
    return lane;
}

// Visits the tiles that a batch's records may reach, 32 tile rows at a time. First, it
// calls begin_row(number, record) in each lane, with the record of that lane's row.
// Then it calls visit(from, row, column) for 32 tiles at a time, one per lane. `from`
// is the lane whose row contains the tile. A negative column means that there is no
// tile.
template <class BeginRow, class Visit>
__device__ void for_each_tile(const TileBinInput& in, const LargeBatch& batch,
                              const LargePart& part, const BeginRow& begin_row,
                              const Visit& visit) {
    const int lane = threadIdx.x % 32,
              total = __shfl_sync(kAllLanes, batch.rows_after, kLargeAtOnce - 1);
    const int end = total * (part.number + 1) >> part.log2_parts;
    for (int first = total * part.number >> part.log2_parts; first < end; first += 32) {
        const int batch_row = min(first + lane, end - 1);
        const int owner = first_lane_above<kLargeAtOnce>(batch.rows_after, batch_row);
        const int row_of_owner =
            batch_row - __shfl_sync(kAllLanes, batch.rows_after - batch.rows, owner);
        const uint32_t number = __shfl_sync(kAllLanes, batch.record, owner);
        const RecordBox box = box_of_lane(batch.box, owner);
        const Record<float> record = load_record(in.records, number, box);
        const TileRun run = tile_run(record, row_of_owner);
        begin_row(number, record);
        const int count = first + lane < end ? run.count : 0;
        const int after = warp_prefix(count), tiles = __shfl_sync(kAllLanes, after, 31);
        for (int tile = lane; tile - lane < tiles; tile += 32) {
            const int from = first_lane_above<32>(after, tile);
            const int row = __shfl_sync(kAllLanes, run.row, from);
            const int column = __shfl_sync(kAllLanes, run.first - (after - count), from) + tile;
            visit(from, row, tile < tiles ? column : -1);
        }
    }
}

// Calls visit(batch, part) for all batches of large records. All warps of the grid must
// call it. If there are few batches, several warps process parts of the same batch.
template <class Visit>
__device__ void for_each_part(const TileBinInput& in, const Visit& visit) {
    constexpr int kLog2MostParts = 2;
    const unsigned num_warps = gridDim.x * (blockDim.x / 32);
    const unsigned num_batches = static_cast<unsigned>(in.counters->large / kLargeAtOnce);
    const unsigned warps_each = num_batches == 0 ? 0 : 8 * num_warps / num_batches;
    const int log2_parts = min(max(31 - __clz(static_cast<int>(warps_each)), 0), kLog2MostParts);
    // Adjacent batches cost about the same, so each goes to a different block.
    for (unsigned at = blockIdx.x + threadIdx.x / 32 * gridDim.x; at < num_batches << log2_parts;
         at += num_warps)
        visit(load_batch(in, static_cast<unsigned long long>(at >> log2_parts) * kLargeAtOnce),
              LargePart{static_cast<int>(at & ((1u << log2_parts) - 1)), log2_parts});
}

// Calls visit(tile) for the tiles of all large records, one tile per lane. A lane
// without a tile gets kNoTile.
template <class Visit>
__device__ void for_each_large_tile(const TileBinInput& in, const Visit& visit) {
    for_each_part(in, [&](const LargeBatch& batch, const LargePart& part) {
        const FrameImage& image = in.images[batch.image];
        for_each_tile(
            in, batch, part, [](uint32_t, const Record<float>&) {},
            [&](int, int row, int column) {
                visit(column < 0 ? kNoTile : image.first_tile + row * image.tile_columns + column);
            });
    });
}

// Adds large records to the counts of their tiles. If there are many large records, and
// shared memory has room for a counter per tile, each block first counts in shared
// memory.
__global__ void __launch_bounds__(kCountThreads, kCountBlocks)
    count_large_kernel(TileBinInput in, bool has_room) {
    await_kernel_before();
    if (!in.capacity.holds(*in.counters)) return;
    if (!has_room || in.counters->large < kLeastLarge * in.num_tiles) {
        for_each_large_tile(in, [&](uint32_t tile) { count_tile(in.counts.count, tile); });
        return;
    }
    uint32_t* counts = reinterpret_cast<uint32_t*>(shared_memory());
    for (uint32_t tile = threadIdx.x; tile < in.num_tiles; tile += kCountThreads) counts[tile] = 0;
    __syncthreads();
    for_each_large_tile(in, [&](uint32_t tile) {
        if (tile != kNoTile) atomicAdd(counts + tile, 1u);
    });
    __syncthreads();
    // Each block starts at a different tile, so that atomic operations rarely collide.
    const uint32_t first = static_cast<uint32_t>(size_t(in.num_tiles) * blockIdx.x / gridDim.x);
    for (uint32_t i = threadIdx.x; i < in.num_tiles; i += kCountThreads) {
        const uint32_t tile = first + i < in.num_tiles ? first + i : first + i - in.num_tiles;
        if (counts[tile] > 0) atomicAdd(in.counts.count + tile, counts[tile]);
    }
}

__device__ uint32_t image_of(const TileBinInput& in, uint32_t tile) {
    // Find the last image whose first tile is at or before this tile.
    uint32_t first = 0, count = in.num_images;
    while (count > 1) {
        const uint32_t half = count / 2;
        const bool later = in.images[first + half].first_tile <= tile;
        first += later ? half : 0;
        count = later ? count - half : half;
    }
    return first;
}

// Computes the first entry of each tile from the counts. Launched with one thread per
// tile.
__global__ void scan_kernel(TileBinInput in, TileBinOutput out) {
    await_kernel_before();
    __shared__ unsigned long long before_block;
    const size_t block = take_ticket(in.counts.scan_ticket);
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
        out.tile_first[tile] = before_block + before_in_block;
        out.image_of_tile[tile] = image_of(in, static_cast<uint32_t>(tile));
    }
    if (block + 1 == gridDim.x && threadIdx.x == 0) {
        out.tile_first[in.num_tiles] = in.counters->entries = before_block + total;
    }
}

// The destination of entries. A tile's list is filled from its end to its beginning.
struct Scatter {
    const unsigned long long* tile_first;
    // [num_tiles] number of free entries; initially the tile's count
    uint32_t* left;
    TileEntry* entries;
};

// The positions of the lanes' entries in the lists of their tiles. Lanes with the same
// tile share one atomic operation.
struct Places {
    unsigned peers;
    // Number of free entries in the tile's list before this warp adds its entries.
    uint32_t left;

    // All lanes of the warp must call it. A lane with kNoTile gets no position.
    __device__ Places(const Scatter& to, uint32_t tile)
        : peers(__match_any_sync(kAllLanes, tile)), left(0) {
        if (tile != kNoTile && threadIdx.x % 32 + 1 == unsigned(__ffs(peers)))
            left = atomicSub(to.left + tile, unsigned(__popc(peers)));
    }
    // Returns the position of this lane's entry in its tile's list. All lanes of the
    // warp must call it.
    __device__ uint32_t own() const {
        const uint32_t of_peers = __shfl_sync(kAllLanes, left, __ffs(peers) - 1);
        return of_peers - 1 - __popc(peers & ((1u << threadIdx.x % 32) - 1));
    }
};

// Number of entries that a warp scatters at once: two per lane, to hide the latency of
// the atomic operation.
constexpr unsigned kAtOnce = 2, kFewAtOnce = 32 * kAtOnce;

// A record that touches few tiles, and the number of one of these tiles.
struct FewPlace {
    FewTiles few;  // kManyTiles if there is no record
    uint32_t record;
    unsigned tile;
};

// A queue of records and tile numbers. It receives all tiles of a record except the
// first one. The warp scatters the queued entries when there are kFewAtOnce of them.
struct WaitingPlaces {
    static constexpr unsigned kMost = kFewAtOnce - 1 + kFewAtOnce * (kFewTiles - 1);
    FewTiles few[kMost];
    uint32_t record[kMost];  // the upper bits contain the number of the tile
};
static_assert(kFewTiles <= 1u << (32 - kMostRecordBits),
              "the number of a tile is stored in the bits above the record");

// Writes one entry per record of `places`. All lanes of the warp must call it.
__device__ void scatter_few(const Scatter& to, const ItemTiles& item,
                            const FewPlace (&places)[kAtOnce]) {
    EntryBox box[kAtOnce];
    uint32_t column[kAtOnce], row[kAtOnce], tile[kAtOnce];
#pragma unroll
    for (unsigned j = 0; j < kAtOnce; ++j) {
        const FewTiles few = places[j].few;
        box[j] = box_of(few);
        const TileBox tiles = tile_box(box[j]);
        column[j] = tiles.columns_to(places[j].tile);
        row[j] = tiles.rows_to(places[j].tile);
        tile[j] = few == kManyTiles
                      ? kNoTile
                      : item.first_tile + tile_of(few) + row[j] * item.columns + column[j];
    }
    static_assert(kAtOnce == 2, "`found` is initialised with two elements");
    const Places found[kAtOnce] = {{to, tile[0]}, {to, tile[1]}};
#pragma unroll
    for (unsigned j = 0; j < kAtOnce; ++j) {
        const uint32_t place = found[j].own();
        if (tile[j] == kNoTile) continue;
        to.entries[to.tile_first[tile[j]] + place] =
            tile_entry(depth_of(places[j].few), places[j].record, box[j], column[j], row[j]);
    }
}

// Scatters the records of an item that touch few tiles. All lanes of the warp must call
// it.
__device__ void scatter_item(const TileBinInput& in, const Scatter& to, const ItemTiles& item,
                             WaitingPlaces& waiting) {
    const unsigned lane = threadIdx.x % 32;
    unsigned num_waiting = 0;
    const auto scatter_waiting = [&](unsigned first) {
        FewPlace places[kAtOnce];
#pragma unroll
        for (unsigned j = 0; j < kAtOnce; ++j) {
            const unsigned at = first + 32 * j + lane;
            const bool is_there = at < num_waiting;
            const uint32_t record = is_there ? waiting.record[at] : 0;
            places[j] = {is_there ? waiting.few[at] : kManyTiles,
                         record & uint32_t(kMostFrameRecords - 1), record >> kMostRecordBits};
        }
        scatter_few(to, item, places);
    };
    const auto few_of = [&](unsigned k) {
        return k < item.num_records ? in.few[item.record + k] : kManyTiles;
    };
    FewTiles next[kAtOnce] = {few_of(lane), few_of(lane + 32)};
    for (unsigned first = 0; first < item.num_records; first += kFewAtOnce) {
        FewPlace places[kAtOnce];
#pragma unroll
        for (unsigned j = 0; j < kAtOnce; ++j) {
            places[j] = {next[j], item.record + first + 32 * j + lane, 0};
            next[j] = few_of(first + kFewAtOnce + 32 * j + lane);
        }
        scatter_few(to, item, places);
#pragma unroll
        for (unsigned j = 0; j < kAtOnce; ++j) {
            const unsigned count =
                places[j].few == kManyTiles ? 0 : tile_box(box_of(places[j].few)).count;
            let_wait(count, num_waiting, [&](unsigned k, unsigned at) {
                waiting.few[at] = places[j].few;
                waiting.record[at] = places[j].record | k << kMostRecordBits;
            });
        }
        __syncwarp();
        for (; num_waiting >= kFewAtOnce; num_waiting -= kFewAtOnce)
            scatter_waiting(num_waiting - kFewAtOnce);
        __syncwarp();
    }
    if (num_waiting > 0) scatter_waiting(0);
    __syncwarp();
}

// Scatters a part of a batch of large records. All lanes of the warp must call it.
__device__ void scatter_large(const TileBinInput& in, const Scatter& to, const LargeBatch& batch,
                              const LargePart& part) {
    const FrameImage& image = in.images[batch.image];
    uint32_t record_of_row = 0, depth_of_row = 0;
    RecordBox blocks_of_row{};
    for_each_tile(
        in, batch, part,
        [&](uint32_t number, const Record<float>& r) {
            record_of_row = number;
            depth_of_row = entry_depth(r.depth, image.camera.near_depth, in.records.depth_mask);
            const EntryBox box = entry_box(r);
            blocks_of_row = {static_cast<uint16_t>(box.x0), static_cast<uint16_t>(box.x1),
                             static_cast<uint16_t>(box.y0), static_cast<uint16_t>(box.y1)};
        },
        [&](int from, int row, int column) {
            const uint32_t record = __shfl_sync(kAllLanes, record_of_row, from),
                           depth = __shfl_sync(kAllLanes, depth_of_row, from);
            const RecordBox box = box_of_lane(blocks_of_row, from);
            const uint32_t tile =
                column < 0 ? kNoTile : image.first_tile + row * image.tile_columns + column;
            const uint32_t place = Places(to, tile).own();
            if (tile == kNoTile) return;
            to.entries[to.tile_first[tile] + place] =
                tile_entry(depth, record, {box.x0, box.x1, box.y0, box.y1}, column, row);
        });
}

// Scatters all records, with large records last. A warp claims its next item when it
// starts the current one, which hides the latency of the atomic operation.
__global__ void __launch_bounds__(kThreads, kBlocks)
    scatter_kernel(TileBinInput in, TileBinOutput out) {
    await_kernel_before();
    if (!in.capacity.holds(*in.counters)) return;
    __shared__ WaitingPlaces waiting[kWarps];
    const Scatter to{out.tile_first, in.counts.count, out.entries};
    const unsigned num_items = static_cast<unsigned>(in.counters->items);
    for (unsigned i = blockIdx.x * kWarps + threadIdx.x / 32; i < num_items;) {
        const unsigned next = take_next(in.counts.taken, gridDim.x * kWarps);
        const ItemTiles item = in.items[i];
        scatter_item(in, to, item, waiting[threadIdx.x / 32]);
        i = __shfl_sync(kAllLanes, next, 0);
    }
    for_each_part(in, [&](const LargeBatch& batch, const LargePart& part) {
        scatter_large(in, to, batch, part);
    });
}

}  // namespace

size_t tile_bin_parts(size_t num_tiles) { return blocks_for(num_tiles, kThreads); }

void tile_bin(const TileBinInput& in, const TileBinOutput& out, cudaStream_t stream) {
    const unsigned resident = kBlocks * num_multiprocessors();
    const size_t counts_bytes = in.num_tiles * sizeof(uint32_t);
    const bool has_room = kCountBlocks * (counts_bytes + 1024) <= shared_memory_of_multiprocessor();
    launch_early("count_large_kernel", count_large_kernel, kCountBlocks * num_multiprocessors(),
                 kCountThreads, has_room ? counts_bytes : 0, stream, in, has_room);
    launch_early("scan_kernel", scan_kernel, blocks_for(in.num_tiles, kThreads), kThreads, 0,
                 stream, in, out);
    launch_early("scatter_kernel", scatter_kernel, resident, kThreads, 0, stream, in, out);
}

}  // namespace cuda
}  // namespace v3dg
