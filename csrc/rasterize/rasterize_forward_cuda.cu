// Blending on CUDA. A block blends a tile, front to back, and its warps process
// sub-tiles.
//
// A list is sorted in pieces, nearest first. Before a piece is sorted, entries that
// cover only stopped pixels are dropped without loading their records. If a list is
// longer than a piece, it is first spread over buckets of depth (spread_lists_cuda.cu),
// and buckets that are longer than a window are spread again. If a tile's list is much
// longer than the average load of a block, several blocks blend parts of the tile
// concurrently.

#include "rasterize/rasterize.h"

#include <algorithm>

#include "base/copy_async.cuh"
#include "rasterize/blend_batch.cuh"
#include "rasterize/piece_sort.cuh"
#include "rasterize/rasterize_math.h"
#include "rasterize/spread_lists_cuda.h"

namespace v3dg {
namespace cuda {
namespace {

// Shared memory usually limits how many blocks a multiprocessor runs, so there are two
// block sizes. Narrow blocks are for multiprocessors with 228 KiB of shared memory. In
// wide blocks, twice as many warps share the memory of a block. Both produce the same
// bits.
using Narrow = BlendShared<128>;
using Wide = BlendShared<256>;
// Number of blocks per multiprocessor that registers allow, without depth.
template <class Shared>
constexpr int kBlocks = 8;
template <>
constexpr int kBlocks<Wide> = 3;
constexpr size_t kReservedBytes = 1024;  // shared memory per block that the driver uses
// If records reach more blocks than this on average, a lane blends two pixels. The
// choice matters little: 4, 7 and 10 differ by 1 % in time.
constexpr int kBlocksForPairs = 5;

template <class Shared>
// without the array for depth
constexpr size_t kBytes = offsetof(Shared, depth) + kReservedBytes;
static_assert(kBlocks<Narrow> * kBytes<Narrow> <= 228 << 10);

// Returns a mask of the blocks in a part of a tile: all of it, a half or a quarter.
__device__ uint32_t blocks_of_part(int part, int log2_parts) {
    if (log2_parts == 0) return ~0u;
    return (log2_parts == 1 ? 0x0f0f0f0fu : 0x0f0fu) << (4 * (part & 1) + 16 * (part >> 1));
}

// Blends the sorted piece.
template <bool kWithDepth, class Stop, class Shared>
__device__ void blend_piece(const RecordPlanes& records, uint32_t count, int left, int top,
                            Shared& s) {
    for (uint32_t first = 0; first < count && s.alive_blocks != 0; first += kBlendBatch) {
        const uint32_t turn = first / kBlendBatch % 2;
        for (uint32_t i = threadIdx.x; i < kBlendBatch; i += Shared::kThreads) {
            uint32_t blocks = 0;
            if (first + i < count) {
                const TileEntry entry{s.key[s.sorted[first + i]]};
                blocks = blocks_of(entry) & s.alive_blocks;
                if (blocks != 0) {
                    const float4* from = ellipse_of(records, records.record_of(entry));
                    for (int k = 0; k < kEllipseVectors; ++k) copy_async(&s.record[k][i], from + k);
                    copy_async(reinterpret_cast<float2*>(&s.record[kEllipseVectors][i]),
                               rest_of(records, records.record_of(entry)));
                }
            }
            s.blocks[i] = blocks;
            const uint32_t num_covered = __reduce_add_sync(kAllLanes, __popc(blocks));
            blocks = __reduce_or_sync(kAllLanes, blocks);
            if (threadIdx.x % 32 == 0 && blocks != 0) {
                atomicOr(&s.reached[turn], blocks);
                atomicAdd(&s.num_covered[turn], num_covered);
            }
        }
        if (threadIdx.x == 0) s.subs_taken = 0;
        wait_for_copies();
        __syncthreads();
        if (threadIdx.x == 0) s.reached[turn ^ 1] = s.num_covered[turn ^ 1] = 0;
        const int num_records = min(count - first, static_cast<uint32_t>(kBlendBatch));
        const uint32_t reached = s.reached[turn];
        // If there are fewer large sub-tiles than warps, small sub-tiles keep all warps
        // busy.
        if (s.num_covered[turn] >= kBlocksForPairs * num_records &&
            __popc(subs_of<2>(reached)) >= Shared::kWarps)
            blend_batch<2, kWithDepth, Stop>(reached, left, top, s);
        else
            blend_batch<1, kWithDepth, Stop>(reached, left, top, s);
        __syncthreads();
    }
    if (threadIdx.x < 2) s.reached[threadIdx.x] = s.num_covered[threadIdx.x] = 0;
}

// Blends the list of a tile. Returns the number of entries that were not dropped.
// `window_ends` is null, or has the ends of the windows of a list that is divided into
// windows and stored in scratch memory.
template <bool kWithDepth, class Stop, class Shared>
__device__ uint32_t blend_list(const RecordPlanes& records, TileEntry* entries, TileEntry* scratch,
                               uint32_t count, const TilePlan& plan, const Buckets& spread_buckets,
                               const uint32_t* window_ends, uint32_t* order, int left, int top,
                               Shared& s) {
    int depth = 0;  // number of levels in use
    if (count > kPiece && window_ends == nullptr) {
        if (threadIdx.x == 0) s.level[0] = {count, plan.in_scratch, spread_buckets};
        depth = 1;
        __syncthreads();
    }
    uint32_t done = 0, blended = 0, num_windows = 0;
    while (s.alive_blocks != 0) {
        uint32_t held = 0;
        while (done < count) {
            while (depth > 0 && s.level[depth - 1].end == done) --depth;
            const SpreadLevel level =
                depth > 0 ? s.level[depth - 1] : SpreadLevel{count, window_ends != nullptr, {}};
            const TileEntry* from = level.in_scratch ? scratch : entries;
            const uint32_t left_over = level.end - done, room = kPiece - held;
            if (window_ends != nullptr) {
                if (room < kWindow) break;
                const uint32_t end = window_ends[num_windows];
                held =
                    take_window(from, done, end, level.buckets, kNoBucket, held, num_windows++, s)
                        .y;
                done = end;
                continue;
            }
            if (left_over <= room) {
                const uint32_t end = done + min(left_over, static_cast<uint32_t>(kWindow));
                const uint2 taken =
                    take_window(from, done, end, level.buckets, kNoBucket, held, num_windows++, s);
                done = end;
                held = taken.y;
                continue;
            }
            if (room < kWindow) break;
            // Take as many whole buckets as fit into the window.
            const uint32_t beyond = level.buckets.of(from[done + kWindow].key);
            const uint2 taken = take_window(from, done, done + kWindow, level.buckets, beyond, held,
                                            num_windows++, s);
            if (taken.x > done) {
                done = taken.x;
                held = taken.y;
                continue;
            }
            // If not even one bucket fits, spread that bucket again.
            const uint32_t end =
                end_of_bucket<Shared::kThreads>(from, done, level.end, level.buckets);
            const Buckets buckets =
                find_buckets<Shared::kThreads>(from, done, end, false, false, s.spreading);
            spread<Shared::kThreads>(from, level.in_scratch ? entries : scratch, done, end, buckets,
                                     s.spreading.bucket, s.spreading.warp_sum);
            if (threadIdx.x == 0) s.level[depth] = {end, !level.in_scratch, buckets};
            __syncthreads();
            ++depth;
        }
        if (held == 0) break;
        sort_piece(records, held, s);
        if (order != nullptr)
            for (uint32_t i = threadIdx.x; i < held; i += Shared::kThreads)
                order[blended + i] = records.record_of(TileEntry{s.key[s.sorted[i]]});
        blended += held;
        blend_piece<kWithDepth, Stop>(records, held, left, top, s);
    }
    return blended;
}

// Returns where an image is drawn. `image` must be an element of lists.images.
__device__ const PicturePlanes& planes_of(const FrameLists& lists, const FrameImage& image) {
    return image.planes.color != nullptr ? image.planes : lists.planes[&image - lists.images];
}

template <bool kWithDepth, class Stop, class Shared>
__device__ void blend_tile(const FrameLists& lists, const RasterTape& tape, const TilePlan& plan,
                           const Buckets& spread_buckets, uint32_t own_blocks,
                           const FrameImage& image, Shared& s) {
    const uint32_t tile = plan.tile;
    const int in_image = static_cast<int>(tile - image.first_tile);
    const int left = in_image % image.tile_columns * kFrameTileWidth;
    const int top = in_image / image.tile_columns * kFrameTileHeight;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    // Calls visit() for each pair of pixels that this thread initialises and writes.
    // There is one pair in each of its sub-tiles.
    using Sub = SubTile<2>;
    const auto for_each_pair = [&](const auto& visit) {
        for (int sub = warp; sub < Sub::kCount; sub += Shared::kWarps)
            if ((own_blocks & blocks_of_sub<2>(sub)) != 0)
                visit(sub, place_of<2>(sub, lane),
                      left + sub % Sub::kColumns * Sub::kWidth + 2 * (lane % 8),
                      top + sub / Sub::kColumns * Sub::kHeight + lane / 8);
    };

    if (threadIdx.x == 0) {
        s.alive_blocks = own_blocks;
        s.window[0] = {0, ~0u};
        s.lowest = ~0u;
        s.highest = 0;
        s.crowded = 0;
        s.stops_behind = stop_of_cut(lists.min_transmittance, lists.counters->choice.tolerance_px2);
        s.reached[0] = s.reached[1] = s.num_covered[0] = s.num_covered[1] = 0;
    }
    __syncthreads();
    for_each_pair([&](int sub, int place, int x, int y) {
        for (int k = 0; k < 2; ++k) {
            s.pixels.transmittance[place + k] =
                x + k < image.width && y < image.height ? 1.0f : -1.0f;
            for (int c = 0; c < 3; ++c) s.pixels.color[c][place + k] = 0.0f;
            if (kWithDepth) s.depth[place + k] = 0.0f;
        }
        publish_alive<2>(x < image.width && y < image.height, sub, s);
    });
    __syncthreads();

    const unsigned long long first = lists.tile_first[tile];
    const uint32_t count = static_cast<uint32_t>(lists.tile_first[tile + 1] - first);
    const uint32_t blended = blend_list<kWithDepth, Stop>(
        lists.records, lists.entries + first, lists.scratch + plan.first_scratch, count, plan,
        spread_buckets,
        plan.in_windows
            ? reinterpret_cast<const uint32_t*>(lists.scratch + plan.first_scratch + count)
            : nullptr,
        tape.order == nullptr ? nullptr : tape.order + first, left, top, s);
    if (tape.blended != nullptr && threadIdx.x == 0) tape.blended[tile] = blended;

    const PicturePlanes& planes = planes_of(lists, image);
    const size_t num_channels = planes.has_four_channels ? 4 : 3;
    for_each_pair([&](int, int place, int x, int y) {
        for (int k = 0; k < 2 && x + k < image.width && y < image.height; ++k) {
            const size_t out = static_cast<size_t>(y) * image.width + x + k;
            const Finished<float> pixel =
                finished(s.pixels.transmittance[place + k], s.stops_behind);
            const float alpha = 1 - pixel.transmittance;
            for (int c = 0; c < 3; ++c)
                planes.color[num_channels * out + c] = pixel.gain * s.pixels.color[c][place + k] +
                                                       pixel.transmittance * image.background[c];
            if (planes.has_four_channels) planes.color[4 * out + 3] = alpha;
            if (planes.alpha != nullptr) planes.alpha[out] = alpha;
            if (kWithDepth)
                planes.depth[out] = alpha > 0 ? pixel.gain * s.depth[place + k] / alpha : 0.0f;
        }
    });
}

// Fills the marked images with NaN, so that pixels of an earlier frame are not mistaken
// for results.
template <class Shared>
__device__ void mark_undrawn(const FrameLists& lists) {
    for (uint32_t k = blockIdx.x; k < lists.num_marked; k += gridDim.x) {
        const FrameImage& image = lists.images[k];
        const PicturePlanes& planes = image.planes;
        const size_t num_pixels = size_t(image.width) * image.height;
        const size_t num_channels = planes.has_four_channels ? 4 : 3;
        for (size_t i = threadIdx.x; i < num_channels * num_pixels; i += Shared::kThreads)
            planes.color[i] = NAN;
        for (size_t i = threadIdx.x; i < num_pixels; i += Shared::kThreads) {
            if (planes.alpha != nullptr) planes.alpha[i] = NAN;
            if (planes.depth != nullptr) planes.depth[i] = NAN;
        }
    }
}

template <class Shared, class Stop>
__global__ void __launch_bounds__(Shared::kThreads, kBlocks<Shared>)
    rasterize_kernel(FrameLists lists, RasterTape tape) {
    await_kernel_before();
    if (blockIdx.x == 0 && threadIdx.x == 0 && lists.report != nullptr)
        *lists.report = *lists.counters;
    if (!lists.capacity.holds(*lists.counters)) {
        mark_undrawn<Shared>(lists);
        return;
    }
    Shared& s = *reinterpret_cast<Shared*>(shared_memory());
    if (lists.plans[blockIdx.x].tile == kNoTile) return;
    const int part = lists.plans[blockIdx.x].part;
    const TilePlan& plan = lists.plans[blockIdx.x - part];
    // Without windows, the first part blends the whole tile.
    if (part > 0 && !plan.in_windows) return;
    const uint32_t own_blocks = blocks_of_part(part, plan.in_windows ? plan.log2_parts : 0);
    const Buckets buckets{
        .lowest = plan.lowest, .last = plan.last_bucket, .shift = plan.shift, .by_order = false};
    const FrameImage& image = lists.images[plan.image];
    if (planes_of(lists, image).depth != nullptr)
        blend_tile<true, Stop>(lists, tape, plan, buckets, own_blocks, image, s);
    else
        blend_tile<false, Stop>(lists, tape, plan, buckets, own_blocks, image, s);
}

// Returns whether the current device has room for all narrow blocks.
bool has_room_for_narrow() {
    return kBlocks<Narrow> * kBytes<Narrow> <= shared_memory_of_multiprocessor();
}

template <class Shared>
uint32_t num_places_for() {
    const size_t blocks = shared_memory_of_multiprocessor() / kBytes<Shared>;
    return static_cast<uint32_t>(std::min<size_t>(blocks, kBlocks<Shared>)) * num_multiprocessors();
}

// Returns how many blocks run concurrently on the current device.
uint32_t num_places() {
    return has_room_for_narrow() ? num_places_for<Narrow>() : num_places_for<Wide>();
}

template <class Shared>
void blend(const FrameLists& lists, const RasterTape& tape, cudaStream_t stream) {
    const size_t shared_bytes = lists.has_depth ? sizeof(Shared) : offsetof(Shared, depth);
    with_stop<float>(lists.min_transmittance, [&](auto stop) {
        launch_early("rasterize_kernel", rasterize_kernel<Shared, decltype(stop)>, lists.num_plans,
                     Shared::kThreads, shared_bytes, stream, lists, tape);
    });
}

}  // namespace

uint32_t most_plans(uint32_t num_tiles) { return most_plans(num_tiles, num_places()); }

void rasterize(const FrameLists& lists, const RasterTape* tape, cudaStream_t stream) {
    spread_lists(lists, num_places(), stream);
    const RasterTape kept = tape == nullptr ? RasterTape{} : *tape;
    if (has_room_for_narrow())
        blend<Narrow>(lists, kept, stream);
    else
        blend<Wide>(lists, kept, stream);
}

}  // namespace cuda
}  // namespace v3dg
