#pragma once

// Buckets of depth, and the spreading of a tile's list over them.

#include "base/scan.cuh"
#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

using EntryKey = unsigned long long;  // a TileEntry as an integer

constexpr int kEntriesAtOnce = 4;  // loads in flight per thread

// Divides the entries of a list into buckets by depth. The buckets have equal widths in
// the bits of depths, which are logarithmic over octaves and linear within an octave.
// If all depths are equal, the widths are equal in the bits of key_order() instead.
struct Buckets {
    uint32_t lowest, last;  // `last` is the index of the last bucket
    int shift;
    bool by_order;

    __device__ uint32_t part_of(EntryKey key) const {
        return by_order ? key_order({key}) : key_depth({key});
    }
    // Returns the bucket of a key. A key outside of the range belongs to the first or
    // the last bucket.
    __device__ uint32_t of(EntryKey key) const {
        return min((max(part_of(key), lowest) - lowest) >> shift, last);
    }
    // Returns the smallest part_of() of the keys of a bucket; 0 for the first bucket.
    __device__ uint32_t begin_of(uint32_t bucket) const {
        return bucket == 0 ? 0 : lowest + (bucket << shift);
    }
};

__device__ inline Buckets buckets_over(uint32_t lowest, uint32_t highest, int log2_buckets,
                                       bool by_order) {
    const int bits = 32 - __clz(static_cast<int>(highest - lowest));
    return {.lowest = lowest,
            .last = (1u << log2_buckets) - 1,
            .shift = max(bits - log2_buckets, 0),
            .by_order = by_order};
}

// Buckets for lists with most entries in a few buckets of equal width (`even`). The
// estimated rank of an entry determines its bucket. The estimate assumes that the
// entries of an even bucket are uniformly distributed in it.
struct FinerBuckets {
    Buckets even;
    const uint32_t* first;  // index of the first entry of each even bucket
    uint32_t count;         // number of entries
    int shift;              // log2 of the number of ranks per bucket

    __device__ uint32_t of(EntryKey key) const {
        const uint32_t bucket = even.of(key);
        const uint32_t begin = first[bucket], end = bucket < even.last ? first[bucket + 1] : count;
        const uint32_t above = even.part_of(key) - even.lowest - (bucket << even.shift);
        return (begin + static_cast<uint32_t>(EntryKey(above) * (end - begin) >> even.shift)) >>
               shift;
    }
};

__device__ inline FinerBuckets finer_buckets(const Buckets& even, const uint32_t* first,
                                             uint32_t count, int log2_buckets) {
    const int bits = 32 - __clz(static_cast<int>(count - 1));
    return {.even = even, .first = first, .count = count, .shift = max(bits - log2_buckets, 0)};
}

// The shared memory of a block that spreads a list.
template <int kLog2Buckets>
struct SpreadShared {
    uint32_t bucket[1 << kLog2Buckets];
    uint32_t range[4];
    uint32_t warp_sum[32];
};

// Replaces counts by prefix sums: the index of each bucket's first entry.
template <int kCount, int kBlock>
__device__ void scan_buckets(uint32_t* bucket, uint32_t* warp_sum) {
    constexpr int kEach = kCount / kBlock;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    uint32_t* own = bucket + kEach * threadIdx.x;
    uint32_t count[kEach], sum = 0;
#pragma unroll
    for (int i = 0; i < kEach; ++i) {
        count[i] = own[i];
        sum += count[i];
    }
    const uint32_t inclusive = warp_prefix(sum);
    if (lane == 31) warp_sum[warp] = inclusive;
    __syncthreads();
    uint32_t first = inclusive - sum;
    for (int w = 0; w < warp; ++w) first += warp_sum[w];
#pragma unroll
    for (int i = 0; i < kEach; ++i) {
        own[i] = first;
        first += count[i];
    }
    __syncthreads();
}

// Calls visit(entry) for each entry of [first, last) that this thread processes.
template <int kBlock, class Visit>
__device__ void for_each_entry(const TileEntry* entries, uint32_t first, uint32_t last,
                               const Visit& visit) {
    for (; first < last; first += kEntriesAtOnce * kBlock) {
        TileEntry entry[kEntriesAtOnce];
#pragma unroll
        for (int k = 0; k < kEntriesAtOnce; ++k) {
            const uint32_t i = first + k * kBlock + threadIdx.x;
            if (i < last) entry[k] = entries[i];
        }
#pragma unroll
        for (int k = 0; k < kEntriesAtOnce; ++k)
            if (first + k * kBlock + threadIdx.x < last) visit(entry[k]);
    }
}

// Returns buckets for the entries [first, last). If `roughly` is true, the range of
// depths is estimated from a sample. If `finely` is true, there are as many buckets as
// possible.
template <int kBlock, int kLog2Buckets>
__device__ Buckets find_buckets(const TileEntry* entries, uint32_t first, uint32_t last,
                                bool roughly, bool finely, SpreadShared<kLog2Buckets>& s) {
    if (threadIdx.x < 4) s.range[threadIdx.x] = threadIdx.x % 2 == 0 ? ~0u : 0u;
    // Ranges of key_depth() and key_order().
    uint32_t low[2] = {~0u, ~0u}, high[2] = {0, 0};
    const auto widen = [&](TileEntry e) {
        const uint32_t part[2] = {key_depth(e), key_order(e)};
        for (int i = 0; i < 2; ++i) {
            low[i] = min(low[i], part[i]);
            high[i] = max(high[i], part[i]);
        }
    };
    if (roughly) {
        // Each thread samples one entry. Such a list has at least as many entries as
        // the block has threads.
        widen(entries[first + static_cast<uint32_t>(static_cast<unsigned long long>(last - first) *
                                                    threadIdx.x / kBlock)]);
    } else {
        for_each_entry<kBlock>(entries, first, last, widen);
    }
    __syncthreads();
    for (int i = 0; i < 2; ++i) {
        low[i] = __reduce_min_sync(kAllLanes, low[i]);
        high[i] = __reduce_max_sync(kAllLanes, high[i]);
        if (threadIdx.x % 32 == 0) {
            atomicMin(&s.range[2 * i], low[i]);
            atomicMax(&s.range[2 * i + 1], high[i]);
        }
    }
    __syncthreads();
    // The number of buckets is chosen for about 64 entries per bucket. Fewer buckets
    // make it more likely that entries written to the same cache line stay in the cache
    // together.
    const int log2_buckets =
        finely ? kLog2Buckets
               : min(max(31 - __clz(static_cast<int>(last - first)) - 6, 4), kLog2Buckets);
    const bool by_order = !roughly && s.range[0] == s.range[1];
    const uint32_t* range = s.range + (by_order ? 2 : 0);
    return buckets_over(range[0], range[1], log2_buckets, by_order);
}

// Counts the entries [first, last) per bucket, and computes the index of each bucket's
// first entry.
template <int kBlock, int kCount, class SomeBuckets>
__device__ void place_buckets(const TileEntry* entries, uint32_t first, uint32_t last,
                              const SomeBuckets& buckets, uint32_t (&bucket)[kCount],
                              uint32_t* warp_sum) {
    for (int i = threadIdx.x; i < kCount; i += kBlock) bucket[i] = 0;
    __syncthreads();
    for_each_entry<kBlock>(entries, first, last,
                           [&](TileEntry e) { atomicAdd(&bucket[buckets.of(e.key)], 1u); });
    __syncthreads();
    scan_buckets<kCount, kBlock>(bucket, warp_sum);
}

// Copies the entries [first, last) into bucket order. Afterwards, bucket[b] is the
// index of the first entry of the bucket after b.
template <int kBlock, int kCount, class SomeBuckets>
__device__ void spread(const TileEntry* from, TileEntry* to, uint32_t first, uint32_t last,
                       const SomeBuckets& buckets, uint32_t (&bucket)[kCount], uint32_t* warp_sum) {
    place_buckets<kBlock>(from, first, last, buckets, bucket, warp_sum);
    for_each_entry<kBlock>(from, first, last, [&](TileEntry e) {
        to[first + atomicAdd(&bucket[buckets.of(e.key)], 1u)] = e;
    });
    __syncthreads();
}

}  // namespace cuda
}  // namespace v3dg
