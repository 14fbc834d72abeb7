// Count, scan, scatter. Records over few tiles have been counted where they were projected; here those over
// many are, their rows of tiles spread over a warp. Compiled without contraction, so that the counting and
// the scattering kernel see the same ellipse.

#include "tile_bin/tile_bin_cuda.h"

#include <algorithm>

#include "base/scan.cuh"
#include "frame/count_tile.cuh"
#include "frame/record.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kThreads = 256, kWarps = kThreads / 32;
constexpr unsigned kBlocks = 5;    // on a multiprocessor
constexpr uint32_t kNoItem = ~0u;  // in place of a number of records

// Large records that a warp takes together; lanes 16 apart have the same one. Neighbours cover the same
// tiles, so a tile is looked at for all of them at once, in windows of so many tiles, unless they lie so
// scattered that a tile has fewer than two of them.
struct LargeBatch {
    uint32_t image;
    uint32_t record;        // of this lane; the first one where it has none
    RecordBox box;          // of that
    int first_row, rows;    // of tiles, of this lane; from `top` on
    int left, top;          // of the tiles that they all lie in
    int columns, all_rows;  // of those
    int window_rows;        // 0 if without windows
    float columns_inverse;
};
constexpr int kMostTiles = 255, kMostRows = 256;

// For each row of each record in a window `count` of its columns from `first` on: first | count << 8.
using WindowRuns = uint16_t[kMostRows];

__device__ LargeBatch load_batch(const TileBinInput& in, unsigned long long first) {
    const LargeRecord mine = in.large[first + threadIdx.x % kLargeAtOnce];
    const LargeRecord& first_one = in.large[first];
    LargeBatch batch{mine.image, first_one.record, first_one.box, 0, 0, 0, 0, 0, 0, 0, 0};
    int left = 1 << 20, top = left, right = -left, bottom = -left, boxes = 0;
    if (mine.record != kNoRecord) {
        batch.record = mine.record;
        batch.box = mine.box;
        left = mine.box.x0 / kFrameTileWidth;
        right = mine.box.x1 / kFrameTileWidth;
        top = mine.box.y0 / kFrameTileHeight;
        bottom = mine.box.y1 / kFrameTileHeight;
        batch.rows = bottom - top + 1;
        boxes = batch.rows * (right - left + 1);
    }
    batch.left = warp_min(left);
    batch.top = warp_min(top);
    batch.first_row = top - batch.top;
    batch.columns = -warp_min(-right) - batch.left + 1;
    batch.all_rows = -warp_min(-bottom) - batch.top + 1;
    batch.columns_inverse = 1 / static_cast<float>(batch.columns);
    const int tiles = batch.columns * batch.all_rows;
    const bool is_dense = tiles <= warp_sum(boxes) / 4;  // two lanes count each box
    // Halfway between two quotients of whole numbers.
    const int fitting = static_cast<int>((kMostTiles + 0.5f) * batch.columns_inverse);
    if (is_dense) batch.window_rows = min(fitting, kMostRows / static_cast<int>(kLargeAtOnce));
    return batch;
}

// Some of the rows of tiles that a batch lies in.
struct LargeRows {
    int top;              // of the picture's
    int tiles;            // in the batch's columns
    int first_row, rows;  // of this lane's record; from `top` on
    int above;            // of the record's rows
    int rows_after;       // of all records up to this one
};

__device__ LargeRows rows_of(const LargeBatch& batch, int first, int count) {
    const int begin = max(batch.first_row, first), end = min(batch.first_row + batch.rows, first + count);
    LargeRows rows{batch.top + first,       min(count, batch.all_rows - first) * batch.columns,
                   begin - first,           max(end - begin, 0),
                   begin - batch.first_row, 0};
    rows.rows_after = warp_prefix<kLargeAtOnce>(rows.rows);
    return rows;
}

// The box of another lane of the warp.
__device__ RecordBox box_of_lane(const RecordBox& box, int lane) {
    const uint32_t columns = __shfl_sync(kAllLanes, box.x0 | uint32_t(box.x1) << 16, lane),
                   rows = __shfl_sync(kAllLanes, box.y0 | uint32_t(box.y1) << 16, lane);
    return {static_cast<uint16_t>(columns), static_cast<uint16_t>(columns >> 16), static_cast<uint16_t>(rows),
            static_cast<uint16_t>(rows >> 16)};
}

// Calls visit(row, number, record, run) for those rows of a batch's records, a lane a row.
template <class Visit>
__device__ void for_each_run(const TileBinInput& in, const LargeBatch& batch, const LargeRows& rows,
                             const Visit& visit) {
    const int lane = threadIdx.x % 32, total = __shfl_sync(kAllLanes, rows.rows_after, kLargeAtOnce - 1);
    const int before = rows.rows_after - rows.rows - rows.above;
    for (int first = 0; first < total; first += 32) {
        // The record that the lane's row is of: the first to end after it.
        const int row = min(first + lane, total - 1);
        int owner = 0;
#pragma unroll
        for (int step = kLargeAtOnce / 2; step > 0; step /= 2)
            if (__shfl_sync(kAllLanes, rows.rows_after, owner + step - 1) <= row) owner += step;
        const int row_of_owner = row - __shfl_sync(kAllLanes, before, owner);
        const uint32_t number = __shfl_sync(kAllLanes, batch.record, owner);
        const RecordBox box = box_of_lane(batch.box, owner);
        if (first + lane >= total) continue;
        const Record<float> record = load_record(in.records, number, box);
        visit(row, number, record, tile_run(record, row_of_owner));
    }
}

// A warp's part of a batch: one window in so many, or so many of the rows.
struct LargePart {
    int number, log2_parts;
};

// Calls visit(batch, part) for all large records, batch by batch; for whole warps of the grid. Where there
// are few batches, several warps take parts of each: a single one may lie over the whole picture.
template <class Visit>
__device__ void for_each_part(const TileBinInput& in, const Visit& visit) {
    constexpr int kLog2MostParts = 2;
    const unsigned num_warps = gridDim.x * kWarps;
    const unsigned num_batches = static_cast<unsigned>(in.counters->large / kLargeAtOnce);
    const unsigned warps_each = num_batches == 0 ? 0 : 8 * num_warps / num_batches;
    const int log2_parts = min(max(31 - __clz(static_cast<int>(warps_each)), 0), kLog2MostParts);
    for (unsigned at = blockIdx.x * kWarps + threadIdx.x / 32; at < num_batches << log2_parts;
         at += num_warps)
        visit(load_batch(in, static_cast<unsigned long long>(at >> log2_parts) * kLargeAtOnce),
              LargePart{static_cast<int>(at & ((1u << log2_parts) - 1)), log2_parts});
}

// Without windows: the rows of a part of a batch.
__device__ LargeRows rows_of(const LargeBatch& batch, const LargePart& part) {
    const int count = (batch.all_rows >> part.log2_parts) + 1;
    return rows_of(batch, part.number * count, count);
}

// Calls visit(window) for the windows of a part of a batch, whose runs are written down.
template <class Visit>
__device__ void for_each_window(const TileBinInput& in, const LargeBatch& batch, const LargePart& part,
                                WindowRuns& runs, const Visit& visit) {
    const int step = batch.window_rows << part.log2_parts;
    for (int first = part.number * batch.window_rows; first < batch.all_rows; first += step) {
        const LargeRows window = rows_of(batch, first, batch.window_rows);
        __syncwarp();  // the window before may still be read
        for_each_run(in, batch, window, [&](int row, uint32_t, const Record<float>&, const TileRun& run) {
            runs[row] = run.count == 0 ? 0 : static_cast<uint16_t>(run.first - batch.left | run.count << 8);
        });
        __syncwarp();
        visit(window);
    }
}

// Tile t of a window.
struct WindowTile {
    int row, column;

    // Halfway between two multiples of 1 / columns, whatever the quotient's last bits.
    __device__ WindowTile(const LargeBatch& batch, int t)
        : row(static_cast<int>((static_cast<float>(t) + 0.5f) * batch.columns_inverse)),
          column(t - row * batch.columns) {}
    __device__ uint32_t index(const FrameImage& image, const LargeBatch& batch,
                              const LargeRows& window) const {
        return image.first_tile + (window.top + row) * image.tile_columns + batch.left + column;
    }
};

// Calls visit(k, tile) for the tiles of the window from `first` on, 32 at most: a tile for the lower half of
// the warp and the next one, which may lie past the window, for the upper half. They are the tiles k and
// k + 1 of those.
template <class Visit>
__device__ void for_each_two_tiles(const LargeBatch& batch, const LargeRows& window, int first,
                                   const Visit& visit) {
    const int upper = threadIdx.x % 32 / kLargeAtOnce, end = min(window.tiles - first, 32);
    for (int k = 0; k < end; k += 2) visit(k, WindowTile(batch, first + k + upper));
}

// Which records of the batch touch the tile first + lane of a window, a bit each.
__device__ uint32_t records_of_tile(const LargeBatch& batch, const LargeRows& window, const WindowRuns& runs,
                                    int first) {
    const unsigned lane = threadIdx.x % 32;
    const int before = window.rows_after - window.rows;
    uint32_t of_tile = 0;
    for_each_two_tiles(batch, window, first, [&](unsigned k, const WindowTile& tile) {
        const int row = tile.row - window.first_row;
        const bool has_row = static_cast<unsigned>(row) < static_cast<unsigned>(window.rows);
        const int run = runs[has_row ? before + row : 0];
        const unsigned both = __ballot_sync(
            kAllLanes, has_row && static_cast<unsigned>(tile.column - (run & 255)) < unsigned(run) >> 8);
        if ((lane & ~1u) == k) of_tile = both;
    });
    return of_tile >> kLargeAtOnce * (lane & 1) & ((1u << kLargeAtOnce) - 1);
}

__global__ void __launch_bounds__(kThreads, kBlocks) count_large_kernel(TileBinInput in) {
    if (!in.capacity.holds(*in.counters)) return;
    __shared__ WindowRuns all_runs[kWarps];
    WindowRuns& runs = all_runs[threadIdx.x / 32];
    for_each_part(in, [&](const LargeBatch& batch, const LargePart& part) {
        const FrameImage& image = in.images[batch.image];
        if (batch.window_rows == 0) {
            for_each_run(in, batch, rows_of(batch, part),
                         [&](int, uint32_t, const Record<float>&, const TileRun& run) {
                             uint32_t* to = in.counts.count + image.first_tile +
                                            run.row * image.tile_columns + run.first;
                             for (int k = 0; k < run.count; ++k) atomicAdd(to + k, 1u);
                         });
            return;
        }
        for_each_window(in, batch, part, runs, [&](const LargeRows& window) {
            for (int first = 0; first < window.tiles; first += 32) {
                const uint32_t records = records_of_tile(batch, window, runs, first);
                const WindowTile tile(batch, first + threadIdx.x % 32);
                if (records != 0)
                    atomicAdd(in.counts.count + tile.index(image, batch, window), unsigned(__popc(records)));
            }
        });
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
        out.tile_first[tile] = before_block + before_in_block;
        out.image_of_tile[tile] = image_of(in, static_cast<uint32_t>(tile));
    }
    if (block + 1 == gridDim.x && threadIdx.x == 0) {
        out.tile_first[in.num_tiles] = in.counters->entries = before_block + total;
    }
}

// Puts entries into their tiles: from the end of a tile's list on, whose count goes down to 0.
struct Scatter {
    const unsigned long long* tile_first;
    uint32_t* left;  // [num_tiles] places
    TileEntry* entries;
};

// The lanes' records over few tiles, by a whole warp. Places are asked for two at a time, as each takes a
// while to come.
__device__ void scatter_few(const Scatter& to, const ItemTiles& item, uint32_t record, FewTiles few) {
    const unsigned lane = threadIdx.x % 32;
    const EntryBox box = box_of(few);
    TileBox tiles = tile_box(box);
    if (few == kManyTiles) tiles.count = 0;
    for (unsigned k = 0; __any_sync(kAllLanes, k < tiles.count); k += 2) {
        uint32_t tile[2], place[2];
        unsigned peers[2];
#pragma unroll
        for (unsigned j = 0; j < 2; ++j) {
            tile[j] = k + j < tiles.count
                          ? item.first_tile + tiles.row(k + j) * item.columns + tiles.column(k + j)
                          : kNoTile;
            peers[j] = __match_any_sync(kAllLanes, tile[j]);
            place[j] = 0;
            if (tile[j] != kNoTile && lane + 1 == unsigned(__ffs(peers[j])))
                place[j] = atomicSub(to.left + tile[j], unsigned(__popc(peers[j])));
        }
#pragma unroll
        for (unsigned j = 0; j < 2; ++j) {
            const uint32_t left = __shfl_sync(kAllLanes, place[j], __ffs(peers[j]) - 1);
            if (tile[j] == kNoTile) continue;
            const unsigned before = __popc(peers[j] & ((1u << lane) - 1));
            to.entries[to.tile_first[tile[j]] + (left - 1 - before)] =
                tile_entry(depth_of(few), record, box, tiles.column(k + j), tiles.row(k + j));
        }
    }
}

// A batch without windows.
__device__ void scatter_runs(const TileBinInput& in, const Scatter& to, const LargeBatch& batch,
                             const LargePart& part) {
    const FrameImage& image = in.images[batch.image];
    const auto visit = [&](int, uint32_t number, const Record<float>& r, const TileRun& run) {
        const uint32_t depth = entry_depth(r.depth, image.camera.near_depth);
        const EntryBox box = entry_box(r);
        for (int k = 0; k < run.count; ++k) {
            const uint32_t tile = image.first_tile + run.row * image.tile_columns + run.first + k;
            to.entries[to.tile_first[tile] + (atomicSub(to.left + tile, 1u) - 1)] =
                tile_entry(depth, number, box, run.first + k, run.row);
        }
    };
    for_each_run(in, batch, rows_of(batch, part), visit);
}

// A batch with windows: what it has for a tile is written at once.
__device__ void scatter_windows(const TileBinInput& in, const Scatter& to, const LargeBatch& batch,
                                const LargePart& part, WindowRuns& runs) {
    const FrameImage& image = in.images[batch.image];
    const unsigned lane = threadIdx.x % 32, mine = lane % kLargeAtOnce;
    const Record<float> r = load_record(in.records, batch.record, batch.box);
    const uint32_t depth = entry_depth(r.depth, image.camera.near_depth);
    const EntryBox box = entry_box(r);
    for_each_window(in, batch, part, runs, [&](const LargeRows& window) {
        for (int first = 0; first < window.tiles; first += 32) {
            const uint32_t records = records_of_tile(batch, window, runs, first);
            unsigned long long place = 0;
            if (records != 0) {
                const uint32_t tile = WindowTile(batch, first + lane).index(image, batch, window),
                               count = __popc(records);
                place = to.tile_first[tile] + (atomicSub(to.left + tile, count) - count);
            }
            for_each_two_tiles(batch, window, first, [&](unsigned k, const WindowTile& tile) {
                const unsigned from = k + lane / kLargeAtOnce;
                const uint32_t of_tile = __shfl_sync(kAllLanes, records, from);
                const unsigned long long begin = __shfl_sync(kAllLanes, place, from);
                if (of_tile >> mine & 1)
                    to.entries[begin + __popc(of_tile & ((1u << mine) - 1))] =
                        tile_entry(depth, batch.record, box, batch.left + tile.column, window.top + tile.row);
            });
        }
    });
}

// Blocks take items, a thread a record, and then the records over many tiles. An item's table is fetched two
// items before its turn, its records one.
__global__ void __launch_bounds__(kThreads, kBlocks) scatter_kernel(TileBinInput in, TileBinOutput out) {
    if (!in.capacity.holds(*in.counters)) return;
    const Scatter to{out.tile_first, in.counts.count, out.entries};
    const unsigned num_items = static_cast<unsigned>(in.counters->items);
    ItemTiles now{0, 0, 0, 0}, next = now;
    FewTiles few = kManyTiles;
    if (blockIdx.x < num_items) next = in.items[blockIdx.x];
    // The first turn is of no item.
    for (unsigned after = blockIdx.x + gridDim.x, turn = 0; turn == 0 || now.num_records != kNoItem; ++turn) {
        ItemTiles later{kNoItem, 0, 0, 0};
        if (after < num_items) later = in.items[after];
        after += gridDim.x;
        FewTiles next_few = kManyTiles;
        if (next.num_records != kNoItem && threadIdx.x < next.num_records)
            next_few = in.few[next.record + threadIdx.x];
        scatter_few(to, now, now.record + threadIdx.x, few);
        now = next;
        next = later;
        few = next_few;
    }
    __shared__ WindowRuns all_runs[kWarps];
    WindowRuns& runs = all_runs[threadIdx.x / 32];
    for_each_part(in, [&](const LargeBatch& batch, const LargePart& part) {
        if (batch.window_rows == 0)
            scatter_runs(in, to, batch, part);
        else
            scatter_windows(in, to, batch, part, runs);
    });
}

}  // namespace

size_t tile_bin_parts(size_t num_tiles) { return blocks_for(num_tiles, kThreads); }

void tile_bin(const TileBinInput& in, const TileBinOutput& out, cudaStream_t stream) {
    static_assert(kThreads == kItemSize, "a thread a record of an item");
    const unsigned resident = kBlocks * num_multiprocessors();
    launch("count_large_kernel", count_large_kernel, resident, kThreads, 0, stream, in);
    launch("scan_kernel", scan_kernel, blocks_for(in.num_tiles, kThreads), kThreads, 0, stream, in, out);
    launch("scatter_kernel", scatter_kernel, resident, kThreads, 0, stream, in, out);
}

}  // namespace cuda
}  // namespace v3dg
