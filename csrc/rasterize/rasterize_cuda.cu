// A block blends a tile, front to back; its warps take the tile's sub-tiles of 8 x 4 pixels in turn.
//
// Lists are sorted piece by piece, nearest first. Entries over pixels that have all stopped by then are
// dropped unsorted, and their records are never fetched. A list that does not fit into a piece is first
// spread over buckets of depth, from one half of its memory to the other; a bucket too long for a window is
// spread again.
//
// Most gaussians cover a pixel or two. So a warp takes 32 records that may reach its sub-tile, each lane
// finds which pixels one of them reaches, and the bits are transposed: a pixel then walks its own records
// only.

#include <algorithm>

#include "base/scan.cuh"
#include "frame/record.cuh"
#include "rasterize/rasterize_cuda.h"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {
namespace {

using Key = unsigned long long;  // of a TileEntry

constexpr int kThreads = 128;
constexpr int kWarps = kThreads / 32;
constexpr int kBlocks = 8;                  // on a multiprocessor
constexpr int kLoads = 4;                   // entries a thread has in flight
constexpr int kWindow = kLoads * kThreads;  // entries looked at in one go
constexpr int kPiece = 3 * kWindow / 2;     // entries sorted at once, at most
constexpr int kLog2Spread = 11;             // buckets of a list, at most
constexpr int kLog2SpreadAgain = 10;        // of what did not fit into a window
constexpr int kLog2Sort = 9;                // buckets of a piece
constexpr int kFewEntries = 64;             // sorted without buckets
constexpr int kBatch = 128;                 // records blended at once
// Each takes some bits of depth or record, at least 4, after the first one, whose range is a guess.
constexpr int kMostLevels = 1 + 26 / 4 + 28 / 4 + 2;

constexpr uint32_t kNoBucket = ~0u;
constexpr int kPlanThreads = 1024;  // of the kernels before the blend

// The pixels that a warp blends at a time, and how many of them a tile has.
constexpr int kSubWidth = 8, kSubHeight = 4, kSubColumns = kFrameTileWidth / kSubWidth;
constexpr int kSubs = kSubColumns * kFrameTileHeight / kSubHeight;

static_assert(kSubWidth == 8 && kSubHeight == 4, "the window of reached_pixels");
static_assert(2 * kFewEntries <= kThreads, "two threads rank an entry");
static_assert(kPiece % 3 == 0 && (kPiece / 3 & (kPiece / 3 - 1)) == 0, "begins a class of plan_kernel");
static_assert(kEntryBlockSize == kSubHeight && 2 * kEntryBlockSize == kSubWidth, "a sub-tile is two blocks");

constexpr int kDepthShift = kEntryRecordBits + kEntryBoxBits;
__device__ uint32_t depth_of(Key key) { return static_cast<uint32_t>(key >> kDepthShift); }

// Buckets of equal width in depth, logarithmic over octaves and linear within, or for equal depths in the
// record.
struct Buckets {
    uint32_t lowest, last;  // `last` is the number of the last bucket
    int shift;
    bool by_record;

    __device__ uint32_t part_of(Key key) const {
        return by_record ? record_of(TileEntry{key}) : depth_of(key);
    }
    // What lies outside of the range that the buckets were made for belongs to the first and to the last.
    __device__ uint32_t of(Key key) const { return min((max(part_of(key), lowest) - lowest) >> shift, last); }
    // The part of a key where a bucket begins; nothing lies before the first.
    __device__ uint32_t begin_of(uint32_t bucket) const {
        return bucket == 0 ? 0 : lowest + (bucket << shift);
    }
};

__device__ Buckets buckets_over(uint32_t lowest, uint32_t highest, int log2_buckets, bool by_record) {
    const int bits = 32 - __clz(static_cast<int>(highest - lowest));
    return {lowest, (1u << log2_buckets) - 1, max(bits - log2_buckets, 0), by_record};
}

// Copies 16 bytes from device to shared memory; they are there once the thread has waited.
__device__ void copy_async(float4* shared, const float4* from) {
#ifdef __CUDA_ARCH__
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(
                     static_cast<unsigned>(__cvta_generic_to_shared(shared))),
                 "l"(from)
                 : "memory");
#else
    *shared = *from;
#endif
}
__device__ void wait_for_copies() {
#ifdef __CUDA_ARCH__
    asm volatile("cp.async.commit_group;\n cp.async.wait_group 0;" ::: "memory");
#endif
}

// What spreading shares in a block.
template <int kLog2Buckets>
struct SpreadShared {
    uint32_t bucket[1 << kLog2Buckets];
    uint32_t range[4];
    uint32_t warp_sum[32];
};

// Turns counts into the place of each bucket's first.
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

// Calls visit(entry) for entries [first, last), a thread's share of them.
template <int kBlock, class Visit>
__device__ void for_each_entry(const TileEntry* entries, uint32_t first, uint32_t last, const Visit& visit) {
    for (; first < last; first += kLoads * kBlock) {
        TileEntry entry[kLoads];
#pragma unroll
        for (int k = 0; k < kLoads; ++k) {
            const uint32_t i = first + k * kBlock + threadIdx.x;
            if (i < last) entry[k] = entries[i];
        }
#pragma unroll
        for (int k = 0; k < kLoads; ++k)
            if (first + k * kBlock + threadIdx.x < last) visit(entry[k]);
    }
}

// Buckets for entries [first, last): for the range of all of them, or of a sample when `roughly`.
template <int kBlock, int kLog2Buckets>
__device__ Buckets find_buckets(const TileEntry* entries, uint32_t first, uint32_t last, bool roughly,
                                SpreadShared<kLog2Buckets>& s) {
    if (threadIdx.x < 4) s.range[threadIdx.x] = threadIdx.x % 2 == 0 ? ~0u : 0u;
    uint32_t low[2] = {~0u, ~0u}, high[2] = {0, 0};  // of depths and records
    const auto widen = [&](TileEntry e) {
        const uint32_t part[2] = {depth_of(e.key), record_of(e)};
        for (int i = 0; i < 2; ++i) {
            low[i] = min(low[i], part[i]);
            high[i] = max(high[i], part[i]);
        }
    };
    if (roughly) {
        // A list that is spread has an entry for each thread.
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
    // Some 64 entries a bucket; the fewer, the more of what is written together stays together in the cache.
    const int log2_buckets = min(max(31 - __clz(static_cast<int>(last - first)) - 6, 4), kLog2Buckets);
    const bool by_record = !roughly && s.range[0] == s.range[1];
    const uint32_t* range = s.range + (by_record ? 2 : 0);
    return buckets_over(range[0], range[1], log2_buckets, by_record);
}

// Spreads entries [first, last) into bucket order, from one place to another.
template <int kBlock, int kLog2Buckets>
__device__ void spread(const TileEntry* from, TileEntry* to, uint32_t first, uint32_t last,
                       const Buckets& buckets, SpreadShared<kLog2Buckets>& s) {
    for (int i = threadIdx.x; i < 1 << kLog2Buckets; i += kBlock) s.bucket[i] = 0;
    __syncthreads();
    for_each_entry<kBlock>(from, first, last,
                           [&](TileEntry e) { atomicAdd(&s.bucket[buckets.of(e.key)], 1u); });
    __syncthreads();
    scan_buckets<1 << kLog2Buckets, kBlock>(s.bucket, s.warp_sum);
    for_each_entry<kBlock>(from, first, last,
                           [&](TileEntry e) { to[first + atomicAdd(&s.bucket[buckets.of(e.key)], 1u)] = e; });
    __syncthreads();
}

// A part [.., end) of the list that lies in bucket order, in the entries or in the scratch.
struct Level {
    uint32_t end;
    bool in_scratch;
    Buckets buckets;
};

// What the warps tell each other of a window. One is filled, the one before still read, the next one emptied.
struct Window {
    uint32_t taken;
    uint32_t end;  // the first entry that is beyond
};

// State of a tile's pixels, sub-tile by sub-tile.
struct Pixels {
    float transmittance[kSubs][32];
    float color[3][kSubs][32];
    float depth[kSubs][32];  // sum of weight * depth
};

struct Shared {
    Key key[kPiece];  // of the piece, in any order
    union {
        SpreadShared<kLog2SpreadAgain> spreading;
        struct {
            uint32_t bucket[1 << kLog2Sort];
            uint32_t warp_sum[kWarps];
            uint16_t by_bucket[kPiece];
        };
        float4 record[kRecordVectors][kBatch];
    };
    uint16_t sorted[kPiece];  // places in `key`
    uint32_t blocks[kBatch];  // live ones that the batch's records may reach
    // Of the batch, those that may reach the sub-tile of a warp: where they begin in a vector of `record`.
    uint32_t list[kWarps][kBatch + 1];
    Pixels pixels;
    uint32_t alive_blocks;  // as blocks_of(TileEntry)
    uint32_t reached[2];    // by some record of the batch, in turn
    uint32_t subs_taken;    // of those reached
    Window window[3];
    uint32_t lowest, highest;  // depths of the piece
    Level level[kMostLevels];
};

// The end of the bucket that entry `first` is in; the entries up to `last` are in bucket order.
__device__ uint32_t end_of_bucket(const TileEntry* entries, uint32_t first, uint32_t last,
                                  const Buckets& buckets) {
    const uint32_t bucket = buckets.of(entries[first].key);
    for (uint32_t at = first; at < last; at += kThreads) {
        const uint32_t i = at + threadIdx.x;
        const uint32_t inside = __syncthreads_count(i < last && buckets.of(entries[i].key) == bucket);
        if (inside < kThreads) return at + inside;
    }
    return last;
}

// Adds those entries [first, end) to the piece that lie over live pixels. Takes none from the bucket `beyond`
// on. Returns where it stopped and how many the piece now holds.
__device__ uint2 take_window(const TileEntry* entries, uint32_t first, uint32_t end, const Buckets& buckets,
                             uint32_t beyond, uint32_t held, uint32_t window_number, Shared& s) {
    const int lane = threadIdx.x % 32;
    Window& window = s.window[window_number % 3];
    TileEntry entry[kLoads];
#pragma unroll
    for (int k = 0; k < kLoads; ++k) {
        const uint32_t i = first + k * kThreads + threadIdx.x;
        if (i < end) entry[k] = entries[i];
    }
    if (threadIdx.x == 0) s.window[(window_number + 1) % 3] = {0, ~0u};
    const uint32_t alive_blocks = s.alive_blocks;
    const bool bounded = beyond != kNoBucket;
    const uint32_t beyond_begin = buckets.begin_of(beyond);
    const bool by_record = buckets.by_record;
    uint32_t live[kLoads], total = 0, lowest = ~0u, highest = 0;
#pragma unroll
    for (int k = 0; k < kLoads; ++k) {
        const uint32_t i = first + k * kThreads + threadIdx.x;
        bool inside = i < end;
        const uint32_t depth = depth_of(entry[k].key);
        if (bounded) {
            const bool is_beyond = inside && (by_record ? record_of(entry[k]) : depth) >= beyond_begin;
            const uint32_t outside = __ballot_sync(kAllLanes, is_beyond);
            if (outside != 0 && lane == __ffs(outside) - 1) atomicMin(&window.end, i);
            inside = inside && !is_beyond;
        }
        const bool is_live = inside && (blocks_of(entry[k]) & alive_blocks) != 0;
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
        for (int k = 0; k < kLoads; ++k) {
            if (live[k] >> lane & 1) s.key[place + __popc(live[k] & ((1u << lane) - 1))] = entry[k].key;
            place += __popc(live[k]);
        }
    }
    __syncthreads();
    return {min(end, window.end), held + window.taken};
}

// Whether the first entry is blended before the second: where the depths of the keys are equal, the records'
// own decide.
__device__ bool precedes(Key first, Key second, const Record<float>* records) {
    if ((first ^ second) >> kDepthShift != 0) return first < second;
    const uint32_t a = record_of(TileEntry{first}), b = record_of(TileEntry{second});
    if (a == b) return false;
    const float depth_a = records[a].depth, depth_b = records[b].depth;
    return depth_a != depth_b ? depth_a < depth_b : a < b;
}

// Sorts the piece.
__device__ void sort_piece(const Record<float>* records, uint32_t count, Shared& s) {
    const Buckets buckets = buckets_over(s.lowest, s.highest, kLog2Sort, false);
    const bool few = count <= kFewEntries;
    if (few) {
        const uint32_t i = threadIdx.x / 2;
        const Key key = s.key[i < count ? i : 0];
        uint32_t rank = 0;
        for (uint32_t j = threadIdx.x % 2; j < count; j += 2) rank += precedes(s.key[j], key, records);
        rank += __shfl_xor_sync(kAllLanes, rank, 1);
        if (i < count && threadIdx.x % 2 == 0) s.sorted[rank] = static_cast<uint16_t>(i);
    } else {
        for (int i = threadIdx.x; i < 1 << kLog2Sort; i += kThreads) s.bucket[i] = 0;
    }
    __syncthreads();
    if (threadIdx.x == 0) {  // for the next piece
        s.lowest = ~0u;
        s.highest = 0;
    }
    if (few) return;
    for (uint32_t i = threadIdx.x; i < count; i += kThreads) atomicAdd(&s.bucket[buckets.of(s.key[i])], 1u);
    __syncthreads();
    scan_buckets<1 << kLog2Sort, kThreads>(s.bucket, s.warp_sum);
    for (uint32_t i = threadIdx.x; i < count; i += kThreads)
        s.by_bucket[atomicAdd(&s.bucket[buckets.of(s.key[i])], 1u)] = static_cast<uint16_t>(i);
    __syncthreads();
    // A bucket's counter now stands where the next one begins.
    for (uint32_t p = threadIdx.x; p < count; p += kThreads) {
        const uint32_t i = s.by_bucket[p];
        const Key key = s.key[i];
        const uint32_t bucket = buckets.of(key), last = s.bucket[bucket];
        const uint32_t first = bucket > 0 ? s.bucket[bucket - 1] : 0;
        uint32_t rank = first;
        for (uint32_t j = first; j < last; ++j) rank += precedes(s.key[s.by_bucket[j]], key, records);
        s.sorted[rank] = static_cast<uint16_t>(i);
    }
    __syncthreads();
}

// Of a sub-tile's two among the tile's blocks.
__device__ int blocks_place(int sub) { return 8 * (sub / kSubColumns) + 2 * (sub % kSubColumns); }

struct Pixel {
    float x, y;  // of the centre
    float transmittance;
    float color[3];
    float depth;
};

// Tells the block which blocks of a sub-tile have died.
__device__ void publish_alive(bool is_alive, int sub, Shared& s) {
    const uint32_t alive = __ballot_sync(kAllLanes, is_alive);
    const uint32_t dead = ((alive & 0x0f0f0f0fu) == 0) | ((alive & 0xf0f0f0f0u) == 0) << 1;
    if (dead != 0 && threadIdx.x % 32 == 0) atomicAnd(&s.alive_blocks, ~(dead << blocks_place(sub)));
}

// Bit j of lane i becomes bit i of lane j.
__device__ uint32_t transpose_bits(uint32_t bits) {
    const unsigned lane = threadIdx.x % 32;
    // Halves and bytes are put together whole: lanes 16, then 8 apart exchange what belongs to the other.
    bits = __byte_perm(bits, __shfl_xor_sync(kAllLanes, bits, 16), (lane & 16) != 0 ? 0x3276 : 0x5410);
    bits = __byte_perm(bits, __shfl_xor_sync(kAllLanes, bits, 8), (lane & 8) != 0 ? 0x3715 : 0x6240);
    uint32_t low_half = 0x0f0f0f0f;
#pragma unroll
    for (unsigned width = 4; width > 0; width /= 2) {
        const bool upper = (lane & width) != 0;
        const uint32_t kept = upper ? ~low_half : low_half;
        const uint32_t other = __shfl_xor_sync(kAllLanes, bits, width);
        bits = (bits & kept) | (__funnelshift_l(other, other, upper ? 32 - width : width) & ~kept);
        low_half ^= low_half << (width / 2);
    }
    return bits;
}

// A warp blends the batch, of `num_groups` times 32 records, over a sub-tile.
template <bool kWithDepth>
__device__ void blend_sub(int sub, int num_groups, int left, int top, Shared& s) {
    const int lane = threadIdx.x % 32;
    uint32_t* list = s.list[threadIdx.x / 32];
    const uint32_t own_blocks = 3u << blocks_place(sub);
    int listed = 0;
    for (int g = 0; g < num_groups; ++g) {
        const bool reaches = (s.blocks[32 * g + lane] & own_blocks) != 0;
        const uint32_t reaching = __ballot_sync(kAllLanes, reaches);
        if (reaches)
            list[listed + __popc(reaching & ((1u << lane) - 1))] =
                static_cast<uint32_t>(sizeof(float4)) * (32 * g + lane);
        listed += __popc(reaching);
    }
    __syncwarp();

    const float corner_x = left + sub % kSubColumns * kSubWidth + 0.5f;
    const float corner_y = top + sub / kSubColumns * kSubHeight + 0.5f;
    Pixels& pixels = s.pixels;
    Pixel p;
    p.x = corner_x + static_cast<float>(lane % kSubWidth);
    p.y = corner_y + static_cast<float>(lane / kSubWidth);
    p.transmittance = pixels.transmittance[sub][lane];
    for (int c = 0; c < 3; ++c) p.color[c] = pixels.color[c][sub][lane];
    if (kWithDepth) p.depth = pixels.depth[sub][lane];
    bool alive = p.transmittance > 0;
    const auto record_at = [&](uint32_t offset) {
        const auto vector = [&](int k) -> const float4& {
            return *reinterpret_cast<const float4*>(reinterpret_cast<const unsigned char*>(s.record[k]) +
                                                    offset);
        };
        return record_of_vectors(vector(0), vector(1), vector(2));
    };
    for (int first = 0; first < listed; first += 32) {
        // The last lane takes the first record, which becomes the highest bit of a pixel.
        const uint32_t* last_of_group = list + first + 31;
        uint32_t bits = 0;
        if (first + 31 - lane < listed) {
            const Record<float> own = record_at(last_of_group[-lane]);
            bits = reached_pixels(own.u - corner_x, own.v - corner_y, own.l11, own.l12, own.l22,
                                  own.log2_opacity);
        }
        bits = transpose_bits(bits);
        if (!alive) bits = 0;
        // Where the next record begins is looked up ahead; after the last one it means nothing.
        int highest = 31 - __clz(static_cast<int>(bits));
        uint32_t next = last_of_group[-highest];
        while (bits != 0) {
            const Record<float> r = record_at(next);
            bits ^= __funnelshift_l(0u, 1u, highest);  // 1 << highest, without a register for the 1
            highest = 31 - __clz(static_cast<int>(bits));
            next = last_of_group[-highest];
            const Falloff<float> f = falloff_at(p.x, p.y, r.u, r.v, r.l11, r.l12, r.l22, r.log2_opacity);
            float weight;
            alive = blend_live(alpha_of(f), p.transmittance, weight);
            for (int c = 0; c < 3; ++c) p.color[c] += weight * r.color[c];
            if (kWithDepth) p.depth += weight * r.depth;
            if (!alive) bits = 0;
        }
        __syncwarp();
    }
    if (!alive) p.transmittance = -fabsf(p.transmittance);
    pixels.transmittance[sub][lane] = p.transmittance;
    for (int c = 0; c < 3; ++c) pixels.color[c][sub][lane] = p.color[c];
    if (kWithDepth) pixels.depth[sub][lane] = p.depth;
    publish_alive(alive, sub, s);
}

// Blends the sorted piece.
template <bool kWithDepth>
__device__ void blend_piece(const Record<float>* records, uint32_t count, int left, int top, Shared& s) {
    for (uint32_t first = 0; first < count && s.alive_blocks != 0; first += kBatch) {
        uint32_t* reached = &s.reached[first / kBatch % 2];
        for (uint32_t i = threadIdx.x; i < kBatch; i += kThreads) {
            uint32_t blocks = 0;
            if (first + i < count) {
                const TileEntry entry{s.key[s.sorted[first + i]]};
                blocks = blocks_of(entry) & s.alive_blocks;
                const float4* from = reinterpret_cast<const float4*>(records + record_of(entry));
                if (blocks != 0)
                    for (int k = 0; k < kRecordVectors; ++k) copy_async(&s.record[k][i], from + k);
            }
            s.blocks[i] = blocks;
            blocks = __reduce_or_sync(kAllLanes, blocks);
            if (threadIdx.x % 32 == 0 && blocks != 0) atomicOr(reached, blocks);
        }
        if (threadIdx.x == 0) s.subs_taken = 0;
        wait_for_copies();
        __syncthreads();
        if (threadIdx.x == 0) s.reached[(first / kBatch + 1) % 2] = 0;
        const int num_groups = (min(count - first, static_cast<uint32_t>(kBatch)) + 31) / 32;
        // A bit for each sub-tile that is reached, where the first of its blocks is.
        uint32_t subs = (*reached | *reached >> 1) & 0x55555555u;
        uint32_t taken = threadIdx.x / 32;  // the first ones are given, the others to whoever is done
        for (uint32_t passed = 0;;) {
            for (; passed < taken; ++passed) subs &= subs - 1;
            if (subs == 0) break;
            blend_sub<kWithDepth>((__ffs(subs) - 1) / 2, num_groups, left, top, s);
            if (threadIdx.x % 32 == 0) taken = kWarps + atomicAdd(&s.subs_taken, 1u);
            taken = __shfl_sync(kAllLanes, taken, 0);
        }
        __syncthreads();
    }
    if (threadIdx.x < 2) s.reached[threadIdx.x] = 0;
}

// Blends the list of a tile. Returns how many of its entries were not dropped.
template <bool kWithDepth>
__device__ uint32_t blend_list(const Record<float>* records, TileEntry* entries, TileEntry* scratch,
                               uint32_t count, const Buckets& spread_buckets, uint32_t* order, int left,
                               int top, Shared& s) {
    int depth = 0;  // of levels
    if (count > kPiece) {
        if (threadIdx.x == 0) s.level[0] = {count, true, spread_buckets};
        depth = 1;
        __syncthreads();
    }
    uint32_t done = 0, blended = 0, num_windows = 0;
    while (s.alive_blocks != 0) {
        uint32_t held = 0;
        while (done < count) {
            while (depth > 0 && s.level[depth - 1].end == done) --depth;
            const Level level = depth > 0 ? s.level[depth - 1] : Level{count, false, {}};
            const TileEntry* from = level.in_scratch ? scratch : entries;
            const uint32_t left_over = level.end - done, room = kPiece - held;
            if (left_over <= room) {
                const uint32_t end = done + min(left_over, static_cast<uint32_t>(kWindow));
                const uint2 taken =
                    take_window(from, done, end, level.buckets, kNoBucket, held, num_windows++, s);
                done = end;
                held = taken.y;
                continue;
            }
            if (room < kWindow) break;
            // As many whole buckets as a window holds.
            const uint32_t beyond = level.buckets.of(from[done + kWindow].key);
            const uint2 taken =
                take_window(from, done, done + kWindow, level.buckets, beyond, held, num_windows++, s);
            if (taken.x > done) {
                done = taken.x;
                held = taken.y;
                continue;
            }
            // Not even one does.
            const uint32_t end = end_of_bucket(from, done, level.end, level.buckets);
            const Buckets buckets = find_buckets<kThreads>(from, done, end, false, s.spreading);
            spread<kThreads>(from, level.in_scratch ? entries : scratch, done, end, buckets, s.spreading);
            if (threadIdx.x == 0) s.level[depth] = {end, !level.in_scratch, buckets};
            __syncthreads();
            ++depth;
        }
        if (held == 0) break;
        sort_piece(records, held, s);
        if (order != nullptr)
            for (uint32_t i = threadIdx.x; i < held; i += kThreads)
                order[blended + i] = record_of(TileEntry{s.key[s.sorted[i]]});
        blended += held;
        blend_piece<kWithDepth>(records, held, left, top, s);
    }
    return blended;
}

template <bool kWithDepth>
__device__ void blend_tile(const FrameLists& lists, const RasterTape& tape, uint32_t tile,
                           const Buckets& spread_buckets, const FrameImage& image, Shared& s) {
    const int in_image = static_cast<int>(tile - image.first_tile);
    const int left = in_image % image.tile_columns * kFrameTileWidth;
    const int top = in_image / image.tile_columns * kFrameTileHeight;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    // A thread begins and ends one pixel of each sub-tile that it takes.
    const auto for_each_pixel = [&](const auto& visit) {
        for (int sub = warp; sub < kSubs; sub += kWarps)
            visit(sub, left + sub % kSubColumns * kSubWidth + lane % kSubWidth,
                  top + sub / kSubColumns * kSubHeight + lane / kSubWidth);
    };

    if (threadIdx.x == 0) {
        s.alive_blocks = ~0u;
        s.window[0] = {0, ~0u};
        s.lowest = ~0u;
        s.highest = 0;
        s.reached[0] = s.reached[1] = 0;
    }
    __syncthreads();
    for_each_pixel([&](int sub, int x, int y) {
        const bool inside = x < image.width && y < image.height;
        s.pixels.transmittance[sub][lane] = inside ? 1.0f : -1.0f;
        for (int c = 0; c < 3; ++c) s.pixels.color[c][sub][lane] = 0.0f;
        if (kWithDepth) s.pixels.depth[sub][lane] = 0.0f;
        publish_alive(inside, sub, s);
    });
    __syncthreads();

    const unsigned long long first = lists.tile_first[tile];
    const uint32_t count = static_cast<uint32_t>(lists.tile_first[tile + 1] - first);
    const uint32_t blended = blend_list<kWithDepth>(
        lists.records, lists.entries + first, lists.scratch + first, count, spread_buckets,
        tape.order == nullptr ? nullptr : tape.order + first, left, top, s);
    if (tape.blended != nullptr && threadIdx.x == 0) tape.blended[tile] = blended;

    for_each_pixel([&](int sub, int x, int y) {
        if (x >= image.width || y >= image.height) return;
        const size_t out = static_cast<size_t>(y) * image.width + x;
        const float t = fabsf(s.pixels.transmittance[sub][lane]);
        for (int c = 0; c < 3; ++c)
            image.color[3 * out + c] = s.pixels.color[c][sub][lane] + t * image.background[c];
        image.alpha[out] = 1 - t;
        if (kWithDepth) image.depth[out] = t < 1 ? s.pixels.depth[sub][lane] / (1 - t) : 0.0f;
    });
}

__device__ uint32_t count_of(const FrameLists& lists, uint32_t tile) {
    return static_cast<uint32_t>(lists.tile_first[tile + 1] - lists.tile_first[tile]);
}

// Plans the tiles by falling load, so that no block is left with a long list at the end. Loads of one class,
// half an octave wide, follow in any order; kPiece begins one.
__global__ void __launch_bounds__(kPlanThreads) plan_kernel(FrameLists lists) {
    constexpr int kClasses = 64;
    __shared__ uint32_t place[kClasses];
    if (!lists.capacity.holds(*lists.counters)) return;
    const auto class_of = [&](uint32_t tile) {
        const uint32_t count = count_of(lists, tile);
        if (count < 2) return kClasses - 1 - static_cast<int>(count);
        const int octave = 31 - __clz(static_cast<int>(count));
        return kClasses - 1 - 2 * octave - static_cast<int>(count >> (octave - 1) & 1);
    };
    // Calls visit(tile, its class) for a thread's share of the tiles, some of whose loads are under way
    // together.
    const auto for_each_tile = [&](const auto& visit) {
        constexpr int kTogether = 4;
        for (uint32_t first = threadIdx.x; first < lists.num_tiles; first += kTogether * kPlanThreads) {
            int tile_class[kTogether];
#pragma unroll
            for (int k = 0; k < kTogether; ++k)
                tile_class[k] = class_of(min(first + k * kPlanThreads, lists.num_tiles - 1));
#pragma unroll
            for (int k = 0; k < kTogether; ++k)
                if (first + k * kPlanThreads < lists.num_tiles)
                    visit(first + k * kPlanThreads, tile_class[k]);
        }
    };
    if (threadIdx.x < kClasses) place[threadIdx.x] = 0;
    __syncthreads();
    for_each_tile([&](uint32_t, int tile_class) { atomicAdd(&place[tile_class], 1u); });
    __syncthreads();
    if (threadIdx.x == 0) {
        uint32_t first = 0;
        for (uint32_t& p : place) {
            const uint32_t count = p;
            p = first;
            first += count;
        }
    }
    __syncthreads();
    for_each_tile([&](uint32_t tile, int tile_class) {
        TilePlan& plan = lists.plans[atomicAdd(&place[tile_class], 1u)];
        plan.tile = tile;
        plan.image = lists.image_of_tile[tile];
    });
}

// Spreads the long lists, a block one after another.
__global__ void __launch_bounds__(kPlanThreads, 2) spread_kernel(FrameLists lists) {
    __shared__ SpreadShared<kLog2Spread> s;
    if (!lists.capacity.holds(*lists.counters)) return;
    for (uint32_t i = blockIdx.x; i < lists.num_tiles; i += gridDim.x) {
        TilePlan& plan = lists.plans[i];
        const uint32_t count = count_of(lists, plan.tile);
        if (count < kPiece) return;  // and so are all that follow
        if (count == kPiece) continue;
        const unsigned long long first = lists.tile_first[plan.tile];
        const Buckets buckets = find_buckets<kPlanThreads>(lists.entries + first, 0, count, true, s);
        spread<kPlanThreads>(lists.entries + first, lists.scratch + first, 0, count, buckets, s);
        if (threadIdx.x == 0) {
            plan.lowest = buckets.lowest;
            plan.last_bucket = static_cast<uint16_t>(buckets.last);
            plan.shift = static_cast<uint16_t>(buckets.shift);
        }
    }
}

__global__ void __launch_bounds__(kThreads, kBlocks) rasterize_kernel(FrameLists lists, RasterTape tape) {
    if (!lists.capacity.holds(*lists.counters)) return;
    Shared& s = *reinterpret_cast<Shared*>(shared_memory());
    const TilePlan plan = lists.plans[blockIdx.x];
    const Buckets buckets{plan.lowest, plan.last_bucket, plan.shift, false};
    const FrameImage& image = lists.images[plan.image];
    if (image.depth != nullptr)
        blend_tile<true>(lists, tape, plan.tile, buckets, image, s);
    else
        blend_tile<false>(lists, tape, plan.tile, buckets, image, s);
}

}  // namespace

void rasterize(const FrameLists& lists, const RasterTape* tape, cudaStream_t stream) {
    if (lists.num_tiles == 0) return;
    launch("plan_kernel", plan_kernel, 1, kPlanThreads, 0, stream, lists);
    launch("spread_kernel", spread_kernel, std::min(2 * num_multiprocessors(), lists.num_tiles), kPlanThreads,
           0, stream, lists);
    launch("rasterize_kernel", rasterize_kernel, lists.num_tiles, kThreads, sizeof(Shared), stream, lists,
           tape == nullptr ? RasterTape{} : *tape);
}

}  // namespace cuda
}  // namespace v3dg
