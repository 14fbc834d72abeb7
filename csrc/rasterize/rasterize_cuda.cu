// A block blends a tile, a thread a pixel, front to back.
//
// Lists are sorted piece by piece, nearest first, and no further than the tile is blended: behind a surface
// most of a list is never looked at. A list that does not fit into a piece is first spread over buckets of
// depth, from one half of its memory to the other; buckets too long for a piece are spread again.
//
// Most gaussians cover a pixel or two. So a batch of sorted records makes a bit matrix, pixels by records:
// each record sets its bit at the pixels of its box that are alive, then each pixel walks its own bits.

#include "base/launch.cuh"
#include "rasterize/rasterize_cuda.h"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {
namespace {

using Key = unsigned long long;  // of a TileEntry

constexpr int kPixels = kFrameTileWidth * kFrameTileHeight;
constexpr int kThreads = kPixels;
constexpr int kWarps = kThreads / 32;
constexpr int kPieceLoads = 4;                  // entries a thread
constexpr int kPiece = kPieceLoads * kThreads;  // sorted at once
constexpr int kLog2Buckets = 11, kBuckets = 1 << kLog2Buckets;
constexpr int kBatch = kThreads;  // blended at once
constexpr int kBatchWords = kBatch / 32;
constexpr int kFewEntries = 64;  // sorted without buckets
// Boxes of more pixels than this set a bit for each 8 x 4 pixels instead.
constexpr int kNarrowPixels = 64;
constexpr int kSubWidth = 8, kSubHeight = 4, kSubColumns = kFrameTileWidth / kSubWidth;
constexpr int kMostLevels = 64 / kLog2Buckets + 1;  // each takes so many bits of the key

static_assert(sizeof(Record<float>) == 48 && sizeof(TileEntry) == sizeof(Key), "loaded as whole words");
static_assert(kFrameTileWidth == 32 && kBuckets % kThreads == 0, "");

// Buckets of equal width in the key, which is logarithmic in depth over octaves and linear within.
struct Buckets {
    Key lowest;
    int shift;
    __device__ uint32_t of(Key key) const { return static_cast<uint32_t>((key - lowest) >> shift); }
};

__device__ Buckets buckets_over(Key lowest, Key highest, int log2_buckets) {
    const int bits = 64 - __clzll(static_cast<long long>(highest - lowest));
    return {lowest, bits > log2_buckets ? bits - log2_buckets : 0};
}

// A part [.., end) of the list that lies in bucket order, in the entries or in the scratch.
struct Level {
    uint32_t end;
    bool in_scratch;
    Buckets buckets;
};

struct Shared {
    union {
        struct {
            Key key[kPiece];
            uint32_t bucket[kBuckets + 1];
        };
        float4 record[3][kBatch];
    };
    uint32_t order[kPiece];
    uint32_t touched[kBatchWords][kPixels];
    uint32_t touched_sub[kBatchWords][kWarps];
    uint32_t alive[kFrameTileHeight];  // a bit a pixel
    Key lowest, highest;
    uint32_t count;
    uint32_t warp_sum[kWarps];
    Level level[kMostLevels];
};

// Adds a thread's extremes and count to the block's, which start_extremes emptied a barrier ago.
__device__ void start_extremes(Shared& s) {
    if (threadIdx.x == 0) {
        s.lowest = ~Key(0);
        s.highest = 0;
        s.count = 0;
    }
}
__device__ void add_extremes(Shared& s, Key lowest, Key highest, uint32_t count) {
    for (int offset = 16; offset > 0; offset /= 2) {
        const Key low = __shfl_xor_sync(kAllLanes, lowest, offset),
                  high = __shfl_xor_sync(kAllLanes, highest, offset);
        lowest = low < lowest ? low : lowest;
        highest = high > highest ? high : highest;
        count += __shfl_xor_sync(kAllLanes, count, offset);
    }
    if (threadIdx.x % 32 == 0 && count > 0) {
        atomicMin(&s.lowest, lowest);
        atomicMax(&s.highest, highest);
        atomicAdd(&s.count, count);
    }
}

// Turns the counts of all buckets into the place of each one's first; the total follows the last.
__device__ void scan_buckets(Shared& s) {
    constexpr int kEach = kBuckets / kThreads;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    uint32_t count[kEach], sum = 0;
    for (int i = 0; i < kEach; ++i) {
        count[i] = s.bucket[kEach * threadIdx.x + i];
        sum += count[i];
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
    for (int i = 0; i < kEach; ++i) {
        s.bucket[kEach * threadIdx.x + i] = first;
        first += count[i];
    }
    if (threadIdx.x == kThreads - 1) s.bucket[kBuckets] = first;
    __syncthreads();
}

// Spreads entries [first, last) into bucket order, from one place to another.
__device__ Buckets spread(const TileEntry* from, TileEntry* to, uint32_t first, uint32_t last, Shared& s) {
    start_extremes(s);
    for (int i = threadIdx.x; i < kBuckets; i += kThreads) s.bucket[i] = 0;
    __syncthreads();
    Key lowest = ~Key(0), highest = 0;
    for (uint32_t i = first + threadIdx.x; i < last; i += kThreads) {
        const Key key = from[i].key;
        lowest = key < lowest ? key : lowest;
        highest = key > highest ? key : highest;
    }
    add_extremes(s, lowest, highest, 1);
    __syncthreads();
    const Buckets buckets = buckets_over(s.lowest, s.highest, kLog2Buckets);
    for (uint32_t i = first + threadIdx.x; i < last; i += kThreads)
        atomicAdd(&s.bucket[buckets.of(from[i].key)], 1u);
    __syncthreads();
    scan_buckets(s);
    for (uint32_t i = first + threadIdx.x; i < last; i += kThreads) {
        const TileEntry entry = from[i];
        to[first + atomicAdd(&s.bucket[buckets.of(entry.key)], 1u)] = entry;
    }
    __syncthreads();
    return buckets;
}

// Sorts the entries of a piece, which its threads hold, into s.order.
__device__ void sort_piece(const Key (&key)[kPieceLoads], const bool (&held)[kPieceLoads], Shared& s) {
    const uint32_t count = s.count;
    const bool few = count <= kFewEntries;
    const Buckets buckets = buckets_over(s.lowest, s.highest, few ? 0 : kLog2Buckets);
    uint32_t bucket[kPieceLoads], place[kPieceLoads];
    if (few) {
        for (int k = 0; k < kPieceLoads; ++k) {
            bucket[k] = 0;
            // The held ones of a few are the first.
            place[k] = k * kThreads + threadIdx.x;
        }
        if (threadIdx.x == 0) {
            s.bucket[0] = 0;
            s.bucket[1] = count;
        }
    } else {
        for (int k = 0; k < kPieceLoads; ++k) {
            bucket[k] = held[k] ? buckets.of(key[k]) : 0;
            if (held[k]) place[k] = atomicAdd(&s.bucket[bucket[k]], 1u);
        }
        __syncthreads();
        scan_buckets(s);
        for (int k = 0; k < kPieceLoads; ++k) place[k] += s.bucket[bucket[k]];
    }
    for (int k = 0; k < kPieceLoads; ++k)
        if (held[k]) s.key[place[k]] = key[k];
    __syncthreads();
    for (int k = 0; k < kPieceLoads; ++k) {
        if (!held[k]) continue;
        const uint32_t first = s.bucket[bucket[k]], last = s.bucket[bucket[k] + 1];
        uint32_t rank = first;
        for (uint32_t i = first; i < last; ++i) rank += s.key[i] < key[k];
        s.order[rank] = record_of(TileEntry{key[k]});
    }
    __syncthreads();
}

struct Pixel {
    float x, y;  // of the centre
    float transmittance;
    float color[3];
    float depth;  // sum of weight * depth
};

// Sets bit `i` of the batch at the live pixels that the record may reach.
__device__ void mark_pixels(const float4 (&words)[3], int i, int left, int top, Shared& s) {
    const uint32_t box_x = __float_as_uint(words[2].z), box_y = __float_as_uint(words[2].w);
    const int x0 = max(static_cast<int>(box_x & 0xffff) - left, 0);
    const int x1 = min(static_cast<int>(box_x >> 16) - left, kFrameTileWidth - 1);
    const int y0 = max(static_cast<int>(box_y & 0xffff) - top, 0);
    const int y1 = min(static_cast<int>(box_y >> 16) - top, kFrameTileHeight - 1);
    const uint32_t word = i / 32, bit = 1u << (i % 32);
    const uint32_t row = (kAllLanes << x0) & (kAllLanes >> (kFrameTileWidth - 1 - x1));
    if ((x1 - x0 + 1) * (y1 - y0 + 1) <= kNarrowPixels) {
        for (int y = y0; y <= y1; ++y)
            for (uint32_t pixels = row & s.alive[y]; pixels != 0; pixels &= pixels - 1)
                atomicOr(&s.touched[word][y * kFrameTileWidth + __ffs(pixels) - 1], bit);
    } else {
        for (int y = y0 / kSubHeight; y <= y1 / kSubHeight; ++y)
            for (int x = x0 / kSubWidth; x <= x1 / kSubWidth; ++x)
                atomicOr(&s.touched_sub[word][y * kSubColumns + x], bit);
    }
}

template <bool kWithDepth>
__device__ void blend_record(const Shared& s, int i, Pixel& p) {
    const float4 a = s.record[0][i], b = s.record[1][i];
    const Falloff<float> f = falloff_at(p.x, p.y, a.x, a.y, a.z, a.w, b.x, b.y);
    if (!contributes(f)) return;
    const float4 c = s.record[2][i];
    const float weight = blend_weight(alpha_of(f), p.transmittance);
    p.color[0] += weight * b.z;
    p.color[1] += weight * b.w;
    p.color[2] += weight * c.x;
    if (kWithDepth) p.depth += weight * c.y;
}

// Blends the records s.order[first .. first + count). Returns whether a pixel of the tile is still alive.
template <bool kWithDepth>
__device__ bool blend_batch(const Record<float>* records, uint32_t first, int count, int left, int top,
                            int pixel, Shared& s, Pixel& p) {
    const int i = threadIdx.x, warp = threadIdx.x / 32, lane = threadIdx.x % 32;
    if (i < count) {
        const float4* at = reinterpret_cast<const float4*>(records + s.order[first + i]);
        const float4 words[3] = {at[0], at[1], at[2]};
        for (int k = 0; k < 3; ++k) s.record[k][i] = words[k];
        mark_pixels(words, i, left, top, s);
    }
    __syncthreads();
    const int num_words = (count + 31) / 32;
    for (int w = 0; w < num_words; ++w) {
        uint32_t bits = s.touched[w][pixel] | s.touched_sub[w][warp];
        s.touched[w][pixel] = 0;
        for (; bits != 0 && p.transmittance > 0; bits &= bits - 1)
            blend_record<kWithDepth>(s, 32 * w + __ffs(bits) - 1, p);
    }
    const uint32_t alive = __ballot_sync(kAllLanes, p.transmittance > 0);
    if (lane < kSubHeight) {
        const int row = warp / kSubColumns * kSubHeight + lane;
        reinterpret_cast<uint8_t*>(&s.alive[row])[warp % kSubColumns] =
            static_cast<uint8_t>(alive >> (lane * kSubWidth));
    }
    for (int w = lane; w < num_words; w += 32) s.touched_sub[w][warp] = 0;
    return __syncthreads_or(p.transmittance > 0) != 0;
}

// Blends the whole list of a tile. Returns how many entries were consumed.
template <bool kWithDepth>
__device__ uint32_t blend_list(const Record<float>* records, TileEntry* entries, TileEntry* scratch,
                               uint32_t count, uint32_t* order, int left, int top, int pixel, Shared& s,
                               Pixel& p) {
    bool alive = __syncthreads_or(p.transmittance > 0) != 0;
    int depth = 0;  // of levels
    uint32_t done = 0;
    while (alive && done < count) {
        while (depth > 0 && s.level[depth - 1].end == done) --depth;
        const Level level = depth > 0 ? s.level[depth - 1] : Level{count, false, {}};
        const TileEntry* from = level.in_scratch ? scratch : entries;
        const bool whole = level.end - done <= kPiece;

        // The next piece: what is left of the level, or as many whole buckets as fit.
        uint32_t beyond = 0;  // bucket that the piece ends before
        uint32_t last = level.end;
        if (!whole && depth > 0) beyond = level.buckets.of(from[done + kPiece].key);
        Key key[kPieceLoads];
        bool held[kPieceLoads];
        Key lowest = ~Key(0), highest = 0;
        uint32_t num_held = 0;
        if (whole || depth > 0) {
            start_extremes(s);
            for (int i = threadIdx.x; i < kBuckets; i += kThreads) s.bucket[i] = 0;
            for (int k = 0; k < kPieceLoads; ++k) {
                const uint32_t i = done + k * kThreads + threadIdx.x;
                held[k] = i < level.end;
                key[k] = held[k] ? from[i].key : 0;
                if (!whole) held[k] = level.buckets.of(key[k]) < beyond;
                if (!held[k]) continue;
                lowest = key[k] < lowest ? key[k] : lowest;
                highest = key[k] > highest ? key[k] : highest;
                ++num_held;
            }
            __syncthreads();
            add_extremes(s, lowest, highest, num_held);
            __syncthreads();
            last = done + s.count;
        }
        if (last == done || (!whole && depth == 0)) {
            // Too long for a piece: a list or a bucket to spread.
            uint32_t end = level.end;
            if (depth > 0) {
                __syncthreads();
                start_extremes(s);
                __syncthreads();
                uint32_t in_bucket = 0;
                for (uint32_t i = done + threadIdx.x; i < level.end; i += kThreads)
                    in_bucket += level.buckets.of(from[i].key) == beyond;
                add_extremes(s, 0, 0, in_bucket);
                __syncthreads();
                end = done + s.count;
                __syncthreads();
            }
            const Buckets buckets = spread(from, level.in_scratch ? entries : scratch, done, end, s);
            if (threadIdx.x == 0) s.level[depth] = {end, !level.in_scratch, buckets};
            __syncthreads();
            ++depth;
            continue;
        }
        sort_piece(key, held, s);
        if (order != nullptr)
            for (uint32_t i = threadIdx.x; i < last - done; i += kThreads) order[done + i] = s.order[i];
        for (uint32_t first = done; alive && first < last; first += kBatch)
            alive = blend_batch<kWithDepth>(records, first - done,
                                            last - first < kBatch ? static_cast<int>(last - first) : kBatch,
                                            left, top, pixel, s, p);
        done = last;
    }
    return done;
}

template <bool kWithDepth>
__device__ void blend_tile(const FrameLists& lists, const RasterTape& tape, uint32_t tile,
                           const FrameImage& image, Shared& s) {
    const int in_image = static_cast<int>(tile - image.first_tile);
    const int left = in_image % image.tile_columns * kFrameTileWidth;
    const int top = in_image / image.tile_columns * kFrameTileHeight;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const int in_tile_x = warp % kSubColumns * kSubWidth + lane % kSubWidth;
    const int in_tile_y = warp / kSubColumns * kSubHeight + lane / kSubWidth;
    const int x = left + in_tile_x, y = top + in_tile_y;
    const bool inside = x < image.width && y < image.height;
    Pixel p = {};
    p.x = x + 0.5f;
    p.y = y + 0.5f;
    p.transmittance = inside ? 1.0f : -1.0f;

    for (int w = 0; w < kBatchWords; ++w) s.touched[w][threadIdx.x] = 0;
    if (threadIdx.x < kBatchWords * kWarps) (&s.touched_sub[0][0])[threadIdx.x] = 0;
    if (threadIdx.x < kFrameTileHeight) s.alive[threadIdx.x] = kAllLanes;

    const unsigned long long first = lists.tile_first[tile];
    const uint32_t count = static_cast<uint32_t>(lists.tile_first[tile + 1] - first);
    const uint32_t blended =
        blend_list<kWithDepth>(lists.records, lists.entries + first, lists.scratch + first, count,
                               tape.order == nullptr ? nullptr : tape.order + first, left, top,
                               in_tile_y * kFrameTileWidth + in_tile_x, s, p);
    if (tape.blended != nullptr && threadIdx.x == 0) tape.blended[tile] = blended;

    if (!inside) return;
    const size_t out = static_cast<size_t>(y) * image.width + x;
    const float t = fabsf(p.transmittance);
    for (int c = 0; c < 3; ++c) image.color[3 * out + c] = p.color[c] + t * image.background[c];
    image.alpha[out] = 1 - t;
    if (kWithDepth) image.depth[out] = t < 1 ? p.depth / (1 - t) : 0.0f;
}

__global__ void __launch_bounds__(kThreads, 2) rasterize_kernel(FrameLists lists, RasterTape tape) {
    if (lists.counters->records > lists.record_capacity || lists.counters->entries > lists.entry_capacity)
        return;
    Shared& s = *reinterpret_cast<Shared*>(shared_memory());
    const uint32_t tile = blockIdx.x;
    const FrameImage& image = lists.images[lists.image_of_tile[tile]];
    if (image.depth != nullptr)
        blend_tile<true>(lists, tape, tile, image, s);
    else
        blend_tile<false>(lists, tape, tile, image, s);
}

}  // namespace

void rasterize(const FrameLists& lists, const RasterTape* tape, cudaStream_t stream) {
    launch("rasterize_kernel", rasterize_kernel, lists.num_tiles, kThreads, sizeof(Shared), stream, lists,
           tape == nullptr ? RasterTape{} : *tape);
}

}  // namespace cuda
}  // namespace v3dg
