#pragma once

// Takes pieces from a tile's list, nearest first, and sorts each of them. Entries that
// cover only stopped pixels are skipped.

#include "frame/record.cuh"
#include "rasterize/tile_lists.cuh"

namespace v3dg {
namespace cuda {

constexpr int kWindow = 512;             // entries that are read together
constexpr int kPiece = 3 * kWindow / 2;  // most entries that are sorted together
// Log2 of the number of buckets when a bucket is spread again.
constexpr int kLog2SpreadAgain = 10;
constexpr int kLog2Sort = 9;         // log2 of the buckets for sorting a piece
constexpr uint32_t kMostAlike = 12;  // a bucket with more entries is crowded
constexpr int kFewEntries = 64;      // lists up to this length need no buckets
constexpr int kBlendBatch = 192;     // records that are blended together
// Maximum number of times that a list is spread. The range of the first level is only
// estimated. Each further level resolves at least 4 bits, first of the depth (26 bits),
// then of the order (28 bits).
constexpr int kMostSpreadLevels = 1 + 26 / 4 + 28 / 4 + 2;
constexpr uint32_t kNoBucket = ~0u;

// The pixels that a warp blends together. Each lane has kPixels adjacent pixels of a
// row.
template <int kPixels>
struct SubTile {
    static constexpr int kWidth = 8 * kPixels, kHeight = 4, kColumns = kFrameTileWidth / kWidth;
    static constexpr int kCount = kColumns * kFrameTileHeight / kHeight;
    // The number of blocks per sub-tile. They are in one row of blocks.
    static constexpr int kBlocks = kWidth / kEntryBlockSize;
};
constexpr int kFrameTilePixels = kFrameTileWidth * kFrameTileHeight;

// A part of the list that is in bucket order. Only its entries before `end` are used.
// It is stored in lists.entries or in scratch memory.
struct SpreadLevel {
    uint32_t end;
    bool in_scratch;
    Buckets buckets;
};

// Counters that warps share while they filter a window of a list. Three instances are
// used in turn: one is active, the previous one may still be read, and the next one is
// being cleared.
struct ListWindow {
    uint32_t taken;
    uint32_t end;  // index after the last entry of the window
};

// The state of a tile's pixels, stored in areas of 8 x 4 pixels. In areas of odd
// columns, the upper and lower halves are exchanged, so that the pixels of half a warp
// are in different banks, both with one and with two pixels per lane.
struct TilePixels {
    alignas(float2) float transmittance[kFrameTilePixels];
    alignas(float2) float color[3][kFrameTilePixels];
};

// The shared memory of a block of kBlendThreads threads.
template <int kBlendThreads>
struct BlendShared {
    static constexpr int kThreads = kBlendThreads, kWarps = kThreads / 32;
    static_assert(2 * kFewEntries <= kThreads, "two threads compute the rank of each entry");
    // Number of loads per thread that are in flight when a window is read.
    static constexpr int kAtOnce = kWindow / kThreads;
    // If more sampled entries than this are in crowded buckets, finer buckets are used.
    // One entry per thread is sampled.
    static constexpr uint32_t kMostCrowded = kThreads / 4;

    EntryKey key[kPiece];  // the entries of the piece, in any order
    union {
        SpreadShared<kLog2SpreadAgain> spreading;
        struct {
            uint32_t bucket[1 << kLog2Sort], finer[1 << kLog2Sort];
            uint32_t warp_sum[kWarps];
            uint16_t by_bucket[kPiece];
        };
        // The records of the batch, without their boxes.
        float4 record[kRecordVectors][kBlendBatch];
    };
    uint16_t sorted[kPiece];  // indices into `key`
    // For each record of the batch, the live blocks that it may reach.
    uint32_t blocks[kBlendBatch];
    // For each warp, the addresses in shared memory of the records that may reach its
    // sub-tile. A list is filled from its end to its beginning. Its first element is
    // never set, but may be loaded early.
    uint16_t list[kWarps][kBlendBatch + 1];
    TilePixels pixels;
    uint32_t alive_blocks;  // one bit per block, as in blocks_of(TileEntry)
    uint32_t reached[2];    // blocks that a batch reaches, for even and odd batches
    // Sum, over the records of a batch, of the number of blocks that each record
    // reaches. The two elements are for even and odd batches.
    uint32_t num_covered[2];
    uint32_t subs_taken;  // number of sub-tiles claimed so far
    ListWindow window[3];
    uint32_t lowest, highest;  // smallest and largest key_depth() in the piece
    uint32_t crowded;          // number of sampled entries in crowded buckets
    float stops_behind;        // StopsBehind::transmittance, or kStopsBefore
    SpreadLevel level[kMostSpreadLevels];
    // Sums of weight * depth, in the order of TilePixels. This must be the last member,
    // because frames without depth do not allocate it.
    alignas(float2) float depth[kFrameTilePixels];
};
static_assert(sizeof(BlendShared<256>) < 1 << 15,
              "addresses in `list` have 16 bits, and BlendShared begins below 32 KiB");
static_assert(kBlendBatch % 32 == 0, "a warp processes 32 records at once");

// Returns the end of the bucket that contains entry `first`. The entries up to `last`
// must be in bucket order.
template <int kThreads>
__device__ uint32_t end_of_bucket(const TileEntry* entries, uint32_t first, uint32_t last,
                                  const Buckets& buckets) {
    const uint32_t bucket = buckets.of(entries[first].key);
    for (uint32_t start = first; start < last; start += kThreads) {
        const uint32_t i = start + threadIdx.x;
        const uint32_t inside =
            __syncthreads_count(i < last && buckets.of(entries[i].key) == bucket);
        if (inside < kThreads) return start + inside;
    }
    return last;
}

// Appends entries of [first, end) to the piece, if they cover live pixels and their
// bucket is before `beyond`. Returns the index at which it stopped, and the new size of
// the piece.
template <class Shared>
__device__ uint2 take_window(const TileEntry* entries, uint32_t first, uint32_t end,
                             const Buckets& buckets, uint32_t beyond, uint32_t held,
                             uint32_t window_number, Shared& s) {
    constexpr int kAtOnce = Shared::kAtOnce;
    const int lane = threadIdx.x % 32;
    ListWindow& window = s.window[window_number % 3];
    TileEntry entry[kAtOnce]{};
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
        const uint32_t i = first + k * Shared::kThreads + threadIdx.x;
        if (i < end) entry[k] = entries[i];
    }
    if (threadIdx.x == 0) s.window[(window_number + 1) % 3] = {0, ~0u};
    const uint32_t alive_blocks = s.alive_blocks;
    const bool bounded = beyond != kNoBucket;
    const uint32_t beyond_begin = buckets.begin_of(beyond);
    const bool by_order = buckets.by_order;
    uint32_t live[kAtOnce], total = 0, lowest = ~0u, highest = 0;
#pragma unroll
    for (int k = 0; k < kAtOnce; ++k) {
        const uint32_t i = first + k * Shared::kThreads + threadIdx.x;
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
        for (int k = 0; k < kAtOnce; ++k) {
            if (live[k] >> lane & 1)
                s.key[place + __popc(live[k] & ((1u << lane) - 1))] = entry[k].key;
            place += __popc(live[k]);
        }
    }
    __syncthreads();
    return {min(end, window.end), held + window.taken};
}

// Returns whether entry `first` is blended before entry `second`. Keys have rounded
// depths; if these are equal, the exact depths of the records are compared.
__device__ inline bool precedes(EntryKey first, EntryKey second, const RecordPlanes& records) {
    const TileEntry one{first}, other{second};
    if (records.depth_of(one) != records.depth_of(other) || records.is_exact(other))
        return first < second;
    const uint32_t a = records.record_of(one), b = records.record_of(other);
    if (a == b) return false;
    const float depth_a = rest_of(records, a)->y, depth_b = rest_of(records, b)->y;
    return depth_a != depth_b ? depth_a < depth_b : a < b;
}

// Returns how many of the elements [first, last) of by_bucket come before the element
// at index p.
template <class Shared>
__device__ uint32_t count_before(uint32_t p, uint32_t first, uint32_t last,
                                 const RecordPlanes& records, const Shared& s) {
    const auto entry_at = [&](uint32_t j) { return TileEntry{s.key[s.by_bucket[j]]}; };
    const TileEntry entry = entry_at(p);
    uint32_t before = 0;
    if (records.is_exact(entry)) {
        for (uint32_t j = first; j < last; ++j) before += entry_at(j).key < entry.key;
        return before;
    }
    const uint32_t depth = records.depth_of(entry);
    uint32_t num_alike = 0, last_alike = 0;  // other entries with the same rounded
                                             // depth
    for (uint32_t j = first; j < last; ++j) {
        const uint32_t other = records.depth_of(entry_at(j));
        before += other < depth;
        if (other == depth && j != p) {
            ++num_alike;
            last_alike = j;
        }
    }
    // In each iteration, all lanes that need records load them together. Most lanes
    // have one other entry of equal depth.
    for (uint32_t j = last_alike; num_alike > 0; --j) {
        if (records.depth_of(entry_at(j)) != depth || j == p) continue;
        before += precedes(entry_at(j).key, entry.key, records);
        --num_alike;
    }
    return before;
}

// The steps of sorting a piece with buckets. Initially, the counter of each bucket is
// 0. It then becomes the index of the bucket's first entry, and finally the index of
// the next bucket's first entry.
template <class SomeBuckets, class Shared>
__device__ void count_buckets(const SomeBuckets& buckets, uint32_t* bucket, uint32_t count,
                              Shared& s) {
    for (uint32_t i = threadIdx.x; i < count; i += Shared::kThreads)
        atomicAdd(&bucket[buckets.of(s.key[i])], 1u);
    __syncthreads();
}
template <class SomeBuckets, class Shared>
__device__ void sort_buckets(const SomeBuckets& buckets, uint32_t* bucket,
                             const RecordPlanes& records, uint32_t count, Shared& s) {
    for (uint32_t i = threadIdx.x; i < count; i += Shared::kThreads)
        s.by_bucket[atomicAdd(&bucket[buckets.of(s.key[i])], 1u)] = static_cast<uint16_t>(i);
    __syncthreads();
    for (uint32_t p = threadIdx.x; p < count; p += Shared::kThreads) {
        const uint32_t i = s.by_bucket[p], own = buckets.of(s.key[i]);
        const uint32_t first = own > 0 ? bucket[own - 1] : 0;
        s.sorted[first + count_before(p, first, bucket[own], records, s)] =
            static_cast<uint16_t>(i);
    }
    __syncthreads();
}

// Sorts the piece, and writes the result to s.sorted.
template <class Shared>
__device__ void sort_piece(const RecordPlanes& records, uint32_t count, Shared& s) {
    constexpr int kThreads = Shared::kThreads;
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
        for (int i = threadIdx.x; i < 1 << kLog2Sort; i += Shared::kThreads) s.bucket[i] = 0;
    }
    __syncthreads();
    if (threadIdx.x == 0) {  // reset for the next piece
        s.lowest = ~0u;
        s.highest = 0;
    }
    if (few) return;
    count_buckets(buckets, s.bucket, count, s);
    // Each entry is compared with every other entry of its bucket, which is slow in
    // crowded buckets. A sample of entries estimates whether finer buckets are faster.
    const bool is_crowded =
        threadIdx.x < count && s.bucket[buckets.of(s.key[threadIdx.x])] > kMostAlike;
    if (is_crowded) atomicAdd(&s.crowded, 1u);
    scan_buckets<1 << kLog2Sort, kThreads>(s.bucket, s.warp_sum);
    if (s.crowded <= Shared::kMostCrowded) {
        sort_buckets(buckets, s.bucket, records, count, s);
    } else {
        const FinerBuckets finer = finer_buckets(buckets, s.bucket, count, kLog2Sort);
        for (int i = threadIdx.x; i < 1 << kLog2Sort; i += Shared::kThreads) s.finer[i] = 0;
        __syncthreads();
        count_buckets(finer, s.finer, count, s);
        scan_buckets<1 << kLog2Sort, kThreads>(s.finer, s.warp_sum);
        sort_buckets(finer, s.finer, records, count, s);
    }
    if (threadIdx.x == 0) s.crowded = 0;  // reset for the next piece
}

}  // namespace cuda
}  // namespace v3dg
