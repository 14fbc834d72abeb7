#pragma once

// Pieces of a tile's list: taken from the list nearest first, without entries over pixels that have
// all stopped, and sorted.

#include "frame/record.cuh"
#include "rasterize/tile_lists.cuh"

namespace v3dg {
namespace cuda {

constexpr int kBlendThreads = 128;
constexpr int kBlendWarps = kBlendThreads / 32;
constexpr int kWindow = kEntriesAtOnce * kBlendThreads;  // entries looked at in one go
constexpr int kPiece = 3 * kWindow / 2;                  // entries sorted at once, at most
constexpr int kLog2SpreadAgain = 10;                  // buckets of what did not fit into a window
constexpr int kLog2Sort = 9;                          // buckets of a piece
constexpr uint32_t kMostAlike = 12;                   // entries of a bucket that is not crowded
constexpr uint32_t kMostCrowded = kBlendThreads / 4;  // of an entry a thread, in crowded buckets
constexpr int kFewEntries = 64;                       // sorted without buckets
constexpr int kBlendBatch = 192;                      // records blended at once
// Each takes some bits of depth or order, at least 4, after the first one, whose range is a guess.
constexpr int kMostSpreadLevels = 1 + 26 / 4 + 28 / 4 + 2;
constexpr uint32_t kNoBucket = ~0u;

// The pixels that a warp blends at a time, kPixels of a row a lane.
template <int kPixels>
struct SubTile {
    static constexpr int kWidth = 8 * kPixels, kHeight = 4, kColumns = kFrameTileWidth / kWidth;
    static constexpr int kCount = kColumns * kFrameTileHeight / kHeight;  // of a tile
    static constexpr int kBlocks = kWidth / kEntryBlockSize;  // of a tile's, side by side
};
constexpr int kFrameTilePixels = kFrameTileWidth * kFrameTileHeight;

static_assert(2 * kFewEntries <= kBlendThreads, "two threads rank an entry");

// A part of the list, up to `end`, that lies in bucket order, in the entries or in the scratch.
struct SpreadLevel {
    uint32_t end;
    bool in_scratch;
    Buckets buckets;
};

// Counts of the warps that look through a window of a list together. There are three: one is filled
// while the one before is still read and the next one is emptied.
struct ListWindow {
    uint32_t taken;
    uint32_t end;  // the first entry that is beyond
};

// State of a tile's pixels, of 8 x 4 after each other. Of those with odd columns the upper and
// lower halves are exchanged: the pixels of half a warp lie in different banks then, with one of
// them a lane and with two.
struct TilePixels {
    alignas(float2) float transmittance[kFrameTilePixels];
    alignas(float2) float color[3][kFrameTilePixels];
};

struct BlendShared {
    EntryKey key[kPiece];  // of the piece, in any order
    union {
        SpreadShared<kLog2SpreadAgain> spreading;
        struct {
            uint32_t bucket[1 << kLog2Sort], finer[1 << kLog2Sort];
            uint32_t warp_sum[kBlendWarps];
            uint16_t by_bucket[kPiece];
        };
        float4 record[kRecordVectors][kBlendBatch];  // without their boxes
    };
    uint16_t sorted[kPiece];       // places in `key`
    uint32_t blocks[kBlendBatch];  // live ones that the batch's records may reach
    // Of the batch, those that may reach the sub-tile of a warp, as addresses in shared memory.
    // They stand from the last place on backwards; the first place is read ahead only.
    uint16_t list[kBlendWarps][kBlendBatch + 1];
    TilePixels pixels;
    uint32_t alive_blocks;    // as blocks_of(TileEntry)
    uint32_t reached[2];      // by some record of the batch, in turn
    uint32_t num_covered[2];  // the same counted once for each record, in turn
    uint32_t subs_taken;      // of those reached
    ListWindow window[3];
    uint32_t lowest, highest;  // depths of the piece
    uint32_t crowded;          // of some of its entries, those with many in their bucket
    float stops_behind;        // StopsBehind::transmittance
    SpreadLevel level[kMostSpreadLevels];
    // Sums of weight * depth, in the order of TilePixels. Frames without depth do not ask for this
    // memory.
    alignas(float2) float depth[kFrameTilePixels];
};
static_assert(sizeof(BlendShared) < 1 << 15,
              "`list` has 16 bits; a block's memory begins within the lower half");
static_assert(kBlendBatch % 32 == 0, "a warp takes 32 records");

// The end of the bucket that entry `first` is in; the entries up to `last` are in bucket order.
__device__ inline uint32_t end_of_bucket(const TileEntry* entries, uint32_t first, uint32_t last,
                                         const Buckets& buckets) {
    const uint32_t bucket = buckets.of(entries[first].key);
    for (uint32_t at = first; at < last; at += kBlendThreads) {
        const uint32_t i = at + threadIdx.x;
        const uint32_t inside =
            __syncthreads_count(i < last && buckets.of(entries[i].key) == bucket);
        if (inside < kBlendThreads) return at + inside;
    }
    return last;
}

// Adds those entries [first, end) to the piece that lie over live pixels. Takes none from the
// bucket `beyond` on. Returns where it stopped and how many the piece now holds.
__device__ inline uint2 take_window(const TileEntry* entries, uint32_t first, uint32_t end,
                                    const Buckets& buckets, uint32_t beyond, uint32_t held,
                                    uint32_t window_number, BlendShared& s) {
    const int lane = threadIdx.x % 32;
    ListWindow& window = s.window[window_number % 3];
    TileEntry entry[kEntriesAtOnce]{};
#pragma unroll
    for (int k = 0; k < kEntriesAtOnce; ++k) {
        const uint32_t i = first + k * kBlendThreads + threadIdx.x;
        if (i < end) entry[k] = entries[i];
    }
    if (threadIdx.x == 0) s.window[(window_number + 1) % 3] = {0, ~0u};
    const uint32_t alive_blocks = s.alive_blocks;
    const bool bounded = beyond != kNoBucket;
    const uint32_t beyond_begin = buckets.begin_of(beyond);
    const bool by_order = buckets.by_order;
    uint32_t live[kEntriesAtOnce], total = 0, lowest = ~0u, highest = 0;
#pragma unroll
    for (int k = 0; k < kEntriesAtOnce; ++k) {
        const uint32_t i = first + k * kBlendThreads + threadIdx.x;
        bool inside = i < end;
        const uint32_t depth = key_depth(entry[k]);
        if (bounded) {
            const bool is_beyond =
                inside && (by_order ? key_order(entry[k]) : depth) >= beyond_begin;
            const uint32_t outside = __ballot_sync(kAllLanes, is_beyond);
            if (outside != 0 && lane == __ffs(outside) - 1) atomicMin(&window.end, i);
            inside = inside && !is_beyond;
        }
        const bool is_live = inside & ((blocks_of(entry[k]) & alive_blocks) != 0);
        lowest = min(lowest, is_live ? depth : ~0u);
        highest = max(highest, is_live ? depth : 0u);
        live[k] = __ballot_sync(kAllLanes, is_live);
        total += __popc(live[k]);
    }
    if (total > 0) {
        lowest = __reduce_min_sync(kAllLanes, lowest);
        highest = __reduce_max_sync(kAllLanes, highest);
        uint32_t place = 0;
        if (lane == 0) {
            place = held + atomicAdd(&window.taken, total);
            atomicMin(&s.lowest, lowest);
            atomicMax(&s.highest, highest);
        }
        place = __shfl_sync(kAllLanes, place, 0);
#pragma unroll
        for (int k = 0; k < kEntriesAtOnce; ++k) {
            if (live[k] >> lane & 1)
                s.key[place + __popc(live[k] & ((1u << lane) - 1))] = entry[k].key;
            place += __popc(live[k]);
        }
    }
    __syncthreads();
    return {min(end, window.end), held + window.taken};
}

// Whether the first entry is blended before the second: where their depths are alike and not exact,
// the records' own decide.
__device__ inline bool precedes(EntryKey first, EntryKey second, const RecordPlanes& records) {
    const TileEntry one{first}, other{second};
    if (records.depth_of(one) != records.depth_of(other) || records.is_exact(other))
        return first < second;
    const uint32_t a = records.record_of(one), b = records.record_of(other);
    if (a == b) return false;
    const float depth_a = rest_of(records, a)->y, depth_b = rest_of(records, b)->y;
    return depth_a != depth_b ? depth_a < depth_b : a < b;
}

// How many of the entries at places [first, last) of by_bucket come before the one at place p.
__device__ inline uint32_t count_before(uint32_t p, uint32_t first, uint32_t last,
                                        const RecordPlanes& records, const BlendShared& s) {
    const auto entry_at = [&](uint32_t j) { return TileEntry{s.key[s.by_bucket[j]]}; };
    const TileEntry own = entry_at(p);
    uint32_t before = 0;
    if (records.is_exact(own)) {
        for (uint32_t j = first; j < last; ++j) before += entry_at(j).key < own.key;
        return before;
    }
    const uint32_t depth = records.depth_of(own);
    uint32_t num_alike = 0, last_alike = 0;  // others
    for (uint32_t j = first; j < last; ++j) {
        const uint32_t other = records.depth_of(entry_at(j));
        before += other < depth;
        if (other == depth && j != p) {
            ++num_alike;
            last_alike = j;
        }
    }
    // The lanes that have to look records up do it together; most of them have one other.
    for (uint32_t j = last_alike; num_alike > 0; --j) {
        if (records.depth_of(entry_at(j)) != depth || j == p) continue;
        before += precedes(entry_at(j).key, own.key, records);
        --num_alike;
    }
    return before;
}

// Sorts the piece by buckets. Their counters are 0, then say where each begins, and in the end
// where the next one does.
template <class SomeBuckets>
__device__ void count_buckets(const SomeBuckets& buckets, uint32_t* bucket, uint32_t count,
                              BlendShared& s) {
    for (uint32_t i = threadIdx.x; i < count; i += kBlendThreads)
        atomicAdd(&bucket[buckets.of(s.key[i])], 1u);
    __syncthreads();
}
template <class SomeBuckets>
__device__ void sort_buckets(const SomeBuckets& buckets, uint32_t* bucket,
                             const RecordPlanes& records, uint32_t count, BlendShared& s) {
    for (uint32_t i = threadIdx.x; i < count; i += kBlendThreads)
        s.by_bucket[atomicAdd(&bucket[buckets.of(s.key[i])], 1u)] = static_cast<uint16_t>(i);
    __syncthreads();
    for (uint32_t p = threadIdx.x; p < count; p += kBlendThreads) {
        const uint32_t i = s.by_bucket[p], own = buckets.of(s.key[i]);
        const uint32_t first = own > 0 ? bucket[own - 1] : 0;
        s.sorted[first + count_before(p, first, bucket[own], records, s)] =
            static_cast<uint16_t>(i);
    }
    __syncthreads();
}

// Sorts the piece.
__device__ inline void sort_piece(const RecordPlanes& records, uint32_t count, BlendShared& s) {
    const Buckets buckets = buckets_over(s.lowest, s.highest, kLog2Sort, false);
    const bool few = count <= kFewEntries;
    if (few) {
        const uint32_t i = threadIdx.x / 2;
        const EntryKey key = s.key[i < count ? i : 0];
        uint32_t rank = 0;
        for (uint32_t j = threadIdx.x % 2; j < count; j += 2)
            rank += precedes(s.key[j], key, records);
        rank += __shfl_xor_sync(kAllLanes, rank, 1);
        if (i < count && threadIdx.x % 2 == 0) s.sorted[rank] = static_cast<uint16_t>(i);
    } else {
        for (int i = threadIdx.x; i < 1 << kLog2Sort; i += kBlendThreads) s.bucket[i] = 0;
    }
    __syncthreads();
    if (threadIdx.x == 0) {  // for the next piece
        s.lowest = ~0u;
        s.highest = 0;
    }
    if (few) return;
    count_buckets(buckets, s.bucket, count, s);
    // Some entries tell whether most have many others in their bucket, each of which costs them a
    // comparison.
    const bool is_crowded =
        threadIdx.x < count && s.bucket[buckets.of(s.key[threadIdx.x])] > kMostAlike;
    if (is_crowded) atomicAdd(&s.crowded, 1u);
    scan_buckets<1 << kLog2Sort, kBlendThreads>(s.bucket, s.warp_sum);
    if (s.crowded <= kMostCrowded) {
        sort_buckets(buckets, s.bucket, records, count, s);
    } else {
        const FinerBuckets finer = finer_buckets(buckets, s.bucket, count, kLog2Sort);
        for (int i = threadIdx.x; i < 1 << kLog2Sort; i += kBlendThreads) s.finer[i] = 0;
        __syncthreads();
        count_buckets(finer, s.finer, count, s);
        scan_buckets<1 << kLog2Sort, kBlendThreads>(s.finer, s.warp_sum);
        sort_buckets(finer, s.finer, records, count, s);
    }
    if (threadIdx.x == 0) s.crowded = 0;  // for the next piece
}

}  // namespace cuda
}  // namespace v3dg
