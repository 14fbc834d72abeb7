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

#include "base/launch.cuh"
#include "rasterize/rasterize_cuda.h"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {
namespace {

using Key = unsigned long long;  // of a TileEntry

constexpr int kThreads = 256;
constexpr int kWarps = kThreads / 32;
constexpr int kLoads = 4;                          // entries a thread has in flight
constexpr int kWindow = kLoads * kThreads;         // entries looked at in one go
constexpr int kPiece = kWindow;                    // entries sorted at once, at most
constexpr int kLog2Spread = 11;                    // buckets of a list
constexpr int kLog2Sort = 10;                      // buckets of a piece
constexpr int kFewEntries = 64;                    // sorted without buckets
constexpr int kBatch = 256;                        // records blended at once
constexpr int kMostLevels = 64 / kLog2Spread + 1;  // each takes so many bits of the key

constexpr uint32_t kNoBucket = ~0u;
constexpr int kOrderThreads = 1024;

// The pixels that a warp blends at a time, and how many of them a tile has.
constexpr int kSubWidth = 8, kSubHeight = 4, kSubColumns = kFrameTileWidth / kSubWidth;
constexpr int kSubs = kSubColumns * kFrameTileHeight / kSubHeight;

static_assert(sizeof(Record<float>) == 3 * sizeof(float4), "fetched as whole vectors");
static_assert(kSubWidth == 8 && kSubHeight == 4, "the window of reached_pixels");
static_assert(kEntryBlockSize == kSubHeight && 2 * kEntryBlockSize == kSubWidth, "a sub-tile is two blocks");

// Buckets of equal width in the key, which is logarithmic in depth over octaves and linear within.
struct Buckets {
    Key lowest;
    int shift;
    __device__ uint32_t of(Key key) const { return static_cast<uint32_t>((key - lowest) >> shift); }
};

__device__ Buckets buckets_over(Key lowest, Key highest, int log2_buckets) {
    const int bits = 64 - __clzll(static_cast<long long>(highest - lowest));
    return {lowest, max(bits - log2_buckets, 0)};
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
        uint32_t bucket[1 << kLog2Spread];
        struct {
            uint32_t sort_bucket[1 << kLog2Sort];  // the same place as `bucket`
            uint16_t by_bucket[kPiece];
        };
        float4 record[3][kBatch];
    };
    uint16_t sorted[kPiece];        // places in `key`
    uint32_t blocks[kBatch];        // live ones that the batch's records may reach
    uint16_t list[kWarps][kBatch];  // of the batch, those that may reach the sub-tile of a warp
    Pixels pixels;
    uint32_t alive_blocks;  // as blocks_of(TileEntry)
    int next_sub;           // that no warp has taken yet
    Window window[3];
    Key lowest, highest;
    uint32_t warp_sum[kWarps];
    Level level[kMostLevels];
};

// Extremes over the block, barriers included.
__device__ Buckets buckets_of_block(Key lowest, Key highest, int log2_buckets, Shared& s) {
    if (threadIdx.x == 0) {
        s.lowest = ~Key(0);
        s.highest = 0;
    }
    for (int offset = 16; offset > 0; offset /= 2) {
        const Key low = __shfl_xor_sync(kAllLanes, lowest, offset),
                  high = __shfl_xor_sync(kAllLanes, highest, offset);
        lowest = low < lowest ? low : lowest;
        highest = high > highest ? high : highest;
    }
    __syncthreads();
    if (threadIdx.x % 32 == 0) {
        atomicMin(&s.lowest, lowest);
        atomicMax(&s.highest, highest);
    }
    __syncthreads();
    return buckets_over(s.lowest, s.highest, log2_buckets);
}

// Turns counts into the place of each bucket's first.
template <int kLog2Buckets>
__device__ void scan_buckets(Shared& s) {
    constexpr int kEach = (1 << kLog2Buckets) / kThreads;
    static_assert(kEach % 4 == 0, "");
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    uint4* own = reinterpret_cast<uint4*>(s.bucket + kEach * threadIdx.x);
    uint4 count[kEach / 4];
    uint32_t sum = 0;
#pragma unroll
    for (int i = 0; i < kEach / 4; ++i) {
        count[i] = own[i];
        sum += count[i].x + count[i].y + count[i].z + count[i].w;
    }
    uint32_t inclusive = sum;
    for (int offset = 1; offset < 32; offset *= 2) {
        const uint32_t below = __shfl_up_sync(kAllLanes, inclusive, offset);
        if (lane >= offset) inclusive += below;
    }
    if (lane == 31) s.warp_sum[warp] = inclusive;
    __syncthreads();
    uint32_t first = inclusive - sum;
    for (int w = 0; w < warp; ++w) first += s.warp_sum[w];
#pragma unroll
    for (int i = 0; i < kEach / 4; ++i) {
        const uint32_t second = first + count[i].x, third = second + count[i].y, fourth = third + count[i].z;
        own[i] = {first, second, third, fourth};
        first = fourth + count[i].w;
    }
    __syncthreads();
}

// Calls visit(entry) for entries [first, last), a thread's share of them.
template <class Visit>
__device__ void for_each_entry(const TileEntry* entries, uint32_t first, uint32_t last, const Visit& visit) {
    for (; first < last; first += kWindow) {
        TileEntry entry[kLoads];
#pragma unroll
        for (int k = 0; k < kLoads; ++k) {
            const uint32_t i = first + k * kThreads + threadIdx.x;
            if (i < last) entry[k] = entries[i];
        }
#pragma unroll
        for (int k = 0; k < kLoads; ++k)
            if (first + k * kThreads + threadIdx.x < last) visit(entry[k]);
    }
}

// Spreads entries [first, last) into bucket order, from one place to another.
__device__ Buckets spread(const TileEntry* from, TileEntry* to, uint32_t first, uint32_t last, Shared& s) {
    for (int i = threadIdx.x; i < 1 << kLog2Spread; i += kThreads) s.bucket[i] = 0;
    Key lowest = ~Key(0), highest = 0;
    for_each_entry(from, first, last, [&](TileEntry e) {
        lowest = min(lowest, e.key);
        highest = max(highest, e.key);
    });
    const Buckets buckets = buckets_of_block(lowest, highest, kLog2Spread, s);
    for_each_entry(from, first, last, [&](TileEntry e) { atomicAdd(&s.bucket[buckets.of(e.key)], 1u); });
    __syncthreads();
    scan_buckets<kLog2Spread>(s);
    for_each_entry(from, first, last,
                   [&](TileEntry e) { to[first + atomicAdd(&s.bucket[buckets.of(e.key)], 1u)] = e; });
    __syncthreads();
    return buckets;
}

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

// Adds those entries of a window to the piece that lie over live pixels; `held` is what it holds. `end`
// becomes the first entry in bucket `beyond` or a later one.
__device__ void take_window(const TileEntry* entries, uint32_t first, uint32_t& end, const Buckets& buckets,
                            uint32_t beyond, uint32_t& held, uint32_t& num_windows, Shared& s) {
    const int lane = threadIdx.x % 32;
    Window& window = s.window[num_windows++ % 3];
    TileEntry entry[kLoads];
    uint32_t live[kLoads], total = 0;
#pragma unroll
    for (int k = 0; k < kLoads; ++k) {
        const uint32_t i = first + k * kThreads + threadIdx.x;
        if (i < end) entry[k] = entries[i];
    }
    if (threadIdx.x == 0) s.window[num_windows % 3] = {0, ~0u};
    const uint32_t alive_blocks = s.alive_blocks;
#pragma unroll
    for (int k = 0; k < kLoads; ++k) {
        const uint32_t i = first + k * kThreads + threadIdx.x;
        const bool inside = i < end && (beyond == kNoBucket || buckets.of(entry[k].key) < beyond);
        const uint32_t outside = __ballot_sync(kAllLanes, i < end && !inside);
        if (outside != 0 && lane == __ffs(outside) - 1) atomicMin(&window.end, i);
        live[k] = __ballot_sync(kAllLanes, inside && (blocks_of(entry[k]) & alive_blocks) != 0);
        total += __popc(live[k]);
    }
    uint32_t place = 0;
    if (lane == 0 && total > 0) place = held + atomicAdd(&window.taken, total);
    place = __shfl_sync(kAllLanes, place, 0);
#pragma unroll
    for (int k = 0; k < kLoads; ++k) {
        if (live[k] >> lane & 1) s.key[place + __popc(live[k] & ((1u << lane) - 1))] = entry[k].key;
        place += __popc(live[k]);
    }
    __syncthreads();
    end = min(end, window.end);
    held += window.taken;
}

// Sorts the piece.
__device__ void sort_piece(uint32_t count, Shared& s) {
    if (count <= kFewEntries) {
        if (threadIdx.x < count) {
            const Key key = s.key[threadIdx.x];
            uint32_t rank = 0;
            for (uint32_t i = 0; i < count; ++i) rank += s.key[i] < key;
            s.sorted[rank] = static_cast<uint16_t>(threadIdx.x);
        }
        __syncthreads();
        return;
    }
    for (int i = threadIdx.x; i < 1 << kLog2Sort; i += kThreads) s.bucket[i] = 0;
    Key lowest = ~Key(0), highest = 0;
    for (uint32_t i = threadIdx.x; i < count; i += kThreads) {
        lowest = min(lowest, s.key[i]);
        highest = max(highest, s.key[i]);
    }
    const Buckets buckets = buckets_of_block(lowest, highest, kLog2Sort, s);
    for (uint32_t i = threadIdx.x; i < count; i += kThreads) atomicAdd(&s.bucket[buckets.of(s.key[i])], 1u);
    __syncthreads();
    scan_buckets<kLog2Sort>(s);
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
        for (uint32_t j = first; j < last; ++j) rank += s.key[s.by_bucket[j]] < key;
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
    __device__ bool alive() const { return transmittance > 0; }
};

// Tells the block which blocks of a sub-tile have died.
__device__ void publish_alive(bool is_alive, int sub, Shared& s) {
    const uint32_t alive = __ballot_sync(kAllLanes, is_alive);
    const uint32_t dead = ((alive & 0x0f0f0f0fu) == 0) | ((alive & 0xf0f0f0f0u) == 0) << 1;
    if (dead != 0 && threadIdx.x % 32 == 0) atomicAnd(&s.alive_blocks, ~(dead << blocks_place(sub)));
}

// Bit j of lane i becomes bit i of lane j.
__device__ uint32_t transpose_bits(uint32_t bits) {
    const int lane = threadIdx.x % 32;
    uint32_t low_half = 0x0000ffff;
#pragma unroll
    for (int width = 16; width > 0; width /= 2) {
        const bool upper = (lane & width) != 0;
        const uint32_t other = __shfl_xor_sync(kAllLanes, bits, width);
        bits = upper ? (bits & ~low_half) | (other >> width & low_half)
                     : (bits & low_half) | (other << width & ~low_half);
        low_half ^= low_half << (width / 2);
    }
    return bits;
}

template <bool kWithDepth>
__device__ void blend_record(const float4 (&record)[3][kBatch], int i, Pixel& p) {
    const float4 a = record[0][i], b = record[1][i];
    const Falloff<float> f = falloff_at(p.x, p.y, a.x, a.y, a.z, a.w, b.x, b.y);
    const float4 c = record[2][i];
    const float weight = blend_weight(alpha_of(f), p.transmittance);
    p.color[0] += weight * b.z;
    p.color[1] += weight * b.w;
    p.color[2] += weight * c.x;
    if (kWithDepth) p.depth += weight * c.y;
}

// A warp blends the batch, of `num_groups` times 32 records, over a sub-tile.
template <bool kWithDepth>
__device__ void blend_sub(int sub, int num_groups, int left, int top, Shared& s) {
    const int lane = threadIdx.x % 32;
    uint16_t* list = s.list[threadIdx.x / 32];
    const uint32_t own_blocks = 3u << blocks_place(sub);
    int listed = 0;
    for (int g = 0; g < num_groups; ++g) {
        const bool reaches = (s.blocks[32 * g + lane] & own_blocks) != 0;
        const uint32_t reaching = __ballot_sync(kAllLanes, reaches);
        if (reaches)
            list[listed + __popc(reaching & ((1u << lane) - 1))] = static_cast<uint16_t>(32 * g + lane);
        listed += __popc(reaching);
    }
    if (listed == 0) return;
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
    for (int first = 0; first < listed; first += 32) {
        const uint16_t* group = list + first;
        uint32_t bits = 0;
        if (first + lane < listed) {
            const float4 a = s.record[0][group[lane]], b = s.record[1][group[lane]];
            bits = reached_pixels(a.x - corner_x, a.y - corner_y, a.z, a.w, b.x, b.y);
        }
        bits = transpose_bits(bits);
        for (; bits != 0 && p.alive(); bits &= bits - 1)
            blend_record<kWithDepth>(s.record, group[__ffs(bits) - 1], p);
        __syncwarp();
    }
    pixels.transmittance[sub][lane] = p.transmittance;
    for (int c = 0; c < 3; ++c) pixels.color[c][sub][lane] = p.color[c];
    if (kWithDepth) pixels.depth[sub][lane] = p.depth;
    publish_alive(p.alive(), sub, s);
}

// Blends the sorted piece.
template <bool kWithDepth>
__device__ void blend_piece(const Record<float>* records, uint32_t count, int left, int top, Shared& s) {
    for (uint32_t first = 0; first < count && s.alive_blocks != 0; first += kBatch) {
        for (uint32_t i = threadIdx.x; i < kBatch; i += kThreads) {
            uint32_t blocks = 0;
            if (first + i < count) {
                const TileEntry entry{s.key[s.sorted[first + i]]};
                blocks = blocks_of(entry) & s.alive_blocks;
                const float4* from = reinterpret_cast<const float4*>(records + record_of(entry));
                if (blocks != 0)
                    for (int k = 0; k < 3; ++k) copy_async(&s.record[k][i], from + k);
            }
            s.blocks[i] = blocks;
        }
        if (threadIdx.x == 0) s.next_sub = 0;
        wait_for_copies();
        const uint32_t alive_blocks = s.alive_blocks;
        __syncthreads();
        const int num_groups = (min(count - first, static_cast<uint32_t>(kBatch)) + 31) / 32;
        while (true) {
            int sub = 0;
            if (threadIdx.x % 32 == 0) sub = atomicAdd(&s.next_sub, 1);
            sub = __shfl_sync(kAllLanes, sub, 0);
            if (sub >= kSubs) break;
            if (alive_blocks >> blocks_place(sub) & 3) blend_sub<kWithDepth>(sub, num_groups, left, top, s);
        }
        __syncthreads();
    }
}

// Blends the list of a tile. Returns how many of its entries were not dropped.
template <bool kWithDepth>
__device__ uint32_t blend_list(const Record<float>* records, TileEntry* entries, TileEntry* scratch,
                               uint32_t count, uint32_t* order, int left, int top, Shared& s) {
    int depth = 0;  // of levels
    uint32_t done = 0, blended = 0, num_windows = 0;
    while (s.alive_blocks != 0) {
        uint32_t held = 0;
        while (done < count) {
            while (depth > 0 && s.level[depth - 1].end == done) --depth;
            const Level level = depth > 0 ? s.level[depth - 1] : Level{count, false, {}};
            const TileEntry* from = level.in_scratch ? scratch : entries;
            const uint32_t left_over = level.end - done, room = kPiece - held;
            uint32_t end = level.end;
            if (left_over <= room) {
                end = done + min(left_over, static_cast<uint32_t>(kWindow));
                take_window(from, done, end, level.buckets, kNoBucket, held, num_windows, s);
                done = end;
                continue;
            }
            if (depth > 0) {
                if (room < kWindow) break;
                // As many whole buckets as a window holds.
                const uint32_t beyond = level.buckets.of(from[done + kWindow].key);
                end = done + kWindow;
                take_window(from, done, end, level.buckets, beyond, held, num_windows, s);
                if (end > done) {
                    done = end;
                    continue;
                }
                end = end_of_bucket(from, done, level.end, level.buckets);
            }
            const Buckets buckets = spread(from, level.in_scratch ? entries : scratch, done, end, s);
            if (threadIdx.x == 0) s.level[depth] = {end, !level.in_scratch, buckets};
            __syncthreads();
            ++depth;
        }
        if (held == 0) break;
        sort_piece(held, s);
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
                           const FrameImage& image, Shared& s) {
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
    const uint32_t blended =
        blend_list<kWithDepth>(lists.records, lists.entries + first, lists.scratch + first, count,
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

__global__ void __launch_bounds__(kThreads, 5) rasterize_kernel(FrameLists lists, RasterTape tape) {
    if (lists.counters->gaussians > lists.record_capacity || lists.counters->entries > lists.entry_capacity)
        return;
    Shared& s = *reinterpret_cast<Shared*>(shared_memory());
    const uint32_t tile = lists.tile_order != nullptr ? lists.tile_order[blockIdx.x] : blockIdx.x;
    const FrameImage& image = lists.images[lists.image_of_tile[tile]];
    if (image.depth != nullptr)
        blend_tile<true>(lists, tape, tile, image, s);
    else
        blend_tile<false>(lists, tape, tile, image, s);
}

// Lists the tiles by falling load, so that no block is left with a long list at the end. Loads of one class,
// half an octave wide, follow in any order.
__global__ void __launch_bounds__(kOrderThreads) order_tiles_kernel(FrameLists lists) {
    constexpr int kClasses = 64;
    __shared__ uint32_t place[kClasses];
    const auto class_of = [&](uint32_t tile) {
        const uint32_t count = static_cast<uint32_t>(lists.tile_first[tile + 1] - lists.tile_first[tile]);
        if (count < 2) return kClasses - 1 - static_cast<int>(count);
        const int octave = 31 - __clz(static_cast<int>(count));
        return kClasses - 1 - 2 * octave - static_cast<int>(count >> (octave - 1) & 1);
    };
    if (threadIdx.x < kClasses) place[threadIdx.x] = 0;
    __syncthreads();
    for (uint32_t t = threadIdx.x; t < lists.num_tiles; t += kOrderThreads)
        atomicAdd(&place[class_of(t)], 1u);
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
    for (uint32_t t = threadIdx.x; t < lists.num_tiles; t += kOrderThreads)
        lists.tile_order[atomicAdd(&place[class_of(t)], 1u)] = t;
}

}  // namespace

void rasterize(const FrameLists& lists, const RasterTape* tape, cudaStream_t stream) {
    if (lists.tile_order != nullptr && lists.num_tiles > 0)
        launch("order_tiles_kernel", order_tiles_kernel, 1, kOrderThreads, 0, stream, lists);
    launch("rasterize_kernel", rasterize_kernel, lists.num_tiles, kThreads, sizeof(Shared), stream, lists,
           tape == nullptr ? RasterTape{} : *tape);
}

}  // namespace cuda
}  // namespace v3dg
