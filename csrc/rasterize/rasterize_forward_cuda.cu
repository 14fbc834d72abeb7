// A block blends a tile, front to back; its warps take the tile's sub-tiles in turn.
//
// Lists are sorted piece by piece, nearest first. Entries over pixels that have all stopped by then are
// dropped unsorted, and their records are never fetched. A list that does not fit into a piece is first
// spread over buckets of depth: in its own place if shared memory holds it, else into scratch, so many
// entries at a time as it holds. A bucket too long for a window is spread again. A list with far more than
// its share of a frame's entries is blended in parts of the tile, side by side.

#include "rasterize/rasterize_cuda.h"

#include <algorithm>

#include "rasterize/blend_batch.cuh"
#include "rasterize/piece_sort.cuh"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {
namespace {

constexpr int kBlocks = 8;         // on a multiprocessor with 228 KiB, of frames without depth
constexpr int kLog2Spread = 11;    // buckets of a list, at most
constexpr int kPlanThreads = 256;  // a thread a tile
constexpr int kSpreadThreads = 1024;
constexpr int kMostParts = 4;  // of a tile
// Blocks a record of a batch, on average, from which two pixels a lane are quicker. Measured: 4, 7 and 10
// differ by a hundredth.
constexpr int kBlocksForPairs = 5;

static_assert(kBlocks * (offsetof(BlendShared, depth) + 1024) <= 228 << 10, "the driver keeps 1024 of each");
static_assert(kPiece % (3 * kMostParts) == 0 && (kPiece / 3 & (kPiece / 3 - 1)) == 0,
              "kPiece / kMostParts begins a class of plan_kernel");

// Copies 16 or 8 bytes from device to shared memory; they are there once the thread has waited.
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
__device__ void copy_async(float2* shared, const float2* from) {
#ifdef __CUDA_ARCH__
    asm volatile("cp.async.ca.shared.global [%0], [%1], 8;" ::"r"(
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

// A part of a tile: the whole, its left or right half, or a quarter. A bit for each of its blocks.
__device__ uint32_t blocks_of_part(int part, int log2_parts) {
    if (log2_parts == 0) return ~0u;
    return (log2_parts == 1 ? 0x0f0f0f0fu : 0x0f0fu) << (4 * (part & 1) + 16 * (part >> 1));
}

// Blends the sorted piece.
template <bool kWithDepth, class Stop>
__device__ void blend_piece(const RecordPlanes& records, uint32_t count, int left, int top, Stop stop,
                            BlendShared& s) {
    for (uint32_t first = 0; first < count && s.alive_blocks != 0; first += kBlendBatch) {
        const uint32_t turn = first / kBlendBatch % 2;
        for (uint32_t i = threadIdx.x; i < kBlendBatch; i += kBlendThreads) {
            uint32_t blocks = 0;
            if (first + i < count) {
                const TileEntry entry{s.key[s.sorted[first + i]]};
                blocks = blocks_of(entry) & s.alive_blocks;
                if (blocks != 0) {
                    const float4* from = ellipse_of(records, record_of(entry));
                    for (int k = 0; k < kEllipseVectors; ++k) copy_async(&s.record[k][i], from + k);
                    copy_async(reinterpret_cast<float2*>(&s.record[kEllipseVectors][i]),
                               rest_of(records, record_of(entry)));
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
        const int num_groups = (num_records + 31) / 32;
        const uint32_t reached = s.reached[turn];
        // Fewer sub-tiles than warps would leave some without work.
        if (s.num_covered[turn] >= kBlocksForPairs * num_records &&
            __popc(subs_of<2>(reached)) >= kBlendWarps)
            blend_batch<2, kWithDepth>(reached, num_groups, left, top, stop, s);
        else
            blend_batch<1, kWithDepth>(reached, num_groups, left, top, stop, s);
        __syncthreads();
    }
    if (threadIdx.x < 2) s.reached[threadIdx.x] = s.num_covered[threadIdx.x] = 0;
}

// Blends the list of a tile. Returns how many of its entries were not dropped. Of a list in windows, which
// lies in the scratch, `window_ends` has where those end; it is null for others.
template <bool kWithDepth, class Stop>
__device__ uint32_t blend_list(const RecordPlanes& records, TileEntry* entries, TileEntry* scratch,
                               uint32_t count, const TilePlan& plan, const Buckets& spread_buckets,
                               const uint32_t* window_ends, uint32_t* order, int left, int top, Stop stop,
                               BlendShared& s) {
    int depth = 0;  // of levels
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
                held = take_window(from, done, end, level.buckets, kNoBucket, held, num_windows++, s).y;
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
            const Buckets buckets = find_buckets<kBlendThreads>(from, done, end, false, false, s.spreading);
            spread<kBlendThreads>(from, level.in_scratch ? entries : scratch, done, end, buckets,
                                  s.spreading.bucket, s.spreading.warp_sum);
            if (threadIdx.x == 0) s.level[depth] = {end, !level.in_scratch, buckets};
            __syncthreads();
            ++depth;
        }
        if (held == 0) break;
        sort_piece(records, held, s);
        if (order != nullptr)
            for (uint32_t i = threadIdx.x; i < held; i += kBlendThreads)
                order[blended + i] = record_of(TileEntry{s.key[s.sorted[i]]});
        blended += held;
        blend_piece<kWithDepth>(records, held, left, top, stop, s);
    }
    return blended;
}

// Where the image is, which lists.images has.
__device__ const PicturePlanes& planes_of(const FrameLists& lists, const FrameImage& image) {
    return image.planes.color != nullptr ? image.planes : lists.planes[&image - lists.images];
}

template <bool kWithDepth, class Stop>
__device__ void blend_tile(const FrameLists& lists, const RasterTape& tape, const TilePlan& plan,
                           const Buckets& spread_buckets, uint32_t own_blocks, const FrameImage& image,
                           Stop stop, BlendShared& s) {
    const uint32_t tile = plan.tile;
    const int in_image = static_cast<int>(tile - image.first_tile);
    const int left = in_image % image.tile_columns * kFrameTileWidth;
    const int top = in_image / image.tile_columns * kFrameTileHeight;
    const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    // A thread begins and ends one pair of pixels of each sub-tile that it takes.
    using Sub = SubTile<2>;
    const auto for_each_pair = [&](const auto& visit) {
        for (int sub = warp; sub < Sub::kCount; sub += kBlendWarps)
            if ((own_blocks & blocks_of_sub<2>(sub)) != 0)
                visit(sub, place_of<2>(sub, lane), left + sub % Sub::kColumns * Sub::kWidth + 2 * (lane % 8),
                      top + sub / Sub::kColumns * Sub::kHeight + lane / 8);
    };

    if (threadIdx.x == 0) {
        s.alive_blocks = own_blocks;
        s.window[0] = {0, ~0u};
        s.lowest = ~0u;
        s.highest = 0;
        s.crowded = 0;
        s.reached[0] = s.reached[1] = s.num_covered[0] = s.num_covered[1] = 0;
    }
    __syncthreads();
    for_each_pair([&](int sub, int place, int x, int y) {
        for (int k = 0; k < 2; ++k) {
            s.pixels.transmittance[place + k] = x + k < image.width && y < image.height ? 1.0f : -1.0f;
            for (int c = 0; c < 3; ++c) s.pixels.color[c][place + k] = 0.0f;
            if (kWithDepth) s.depth[place + k] = 0.0f;
        }
        publish_alive<2>(x < image.width && y < image.height, sub, s);
    });
    __syncthreads();

    const unsigned long long first = lists.tile_first[tile];
    const uint32_t count = static_cast<uint32_t>(lists.tile_first[tile + 1] - first);
    const uint32_t blended = blend_list<kWithDepth>(
        lists.records, lists.entries + first, lists.scratch + plan.first_scratch, count, plan, spread_buckets,
        plan.in_windows ? reinterpret_cast<const uint32_t*>(lists.scratch + plan.first_scratch + count)
                        : nullptr,
        tape.order == nullptr ? nullptr : tape.order + first, left, top, stop, s);
    if (tape.blended != nullptr && threadIdx.x == 0) tape.blended[tile] = blended;

    const PicturePlanes& planes = planes_of(lists, image);
    for_each_pair([&](int, int place, int x, int y) {
        for (int k = 0; k < 2 && x + k < image.width && y < image.height; ++k) {
            const size_t out = static_cast<size_t>(y) * image.width + x + k;
            const Finished<float> of = finished(s.pixels.transmittance[place + k], lists.min_transmittance);
            const float alpha = 1 - of.transmittance;
            for (int c = 0; c < 3; ++c)
                planes.color[3 * out + c] =
                    of.gain * s.pixels.color[c][place + k] + of.transmittance * image.background[c];
            planes.alpha[out] = alpha;
            if (kWithDepth) planes.depth[out] = alpha > 0 ? of.gain * s.depth[place + k] / alpha : 0.0f;
        }
    });
}

__device__ uint32_t count_of(const FrameLists& lists, uint32_t tile) {
    return static_cast<uint32_t>(lists.tile_first[tile + 1] - lists.tile_first[tile]);
}

// How tiles are planned, by two kernels with a thread a tile: by falling load, so that no block is left with
// a long list at the end. Loads of one class, half an octave wide, follow in any order. Where few tiles have
// most of the entries, as of an asset in the middle of a picture, they are blended in parts, each by a block
// that drops what does not reach it: there are `num_places` for blocks at a time, and no block is to have
// much more than its share.
struct PlanRules {
    uint32_t share;
    bool has_parts;

    __device__ PlanRules(const FrameLists& lists, uint32_t num_places)
        : share(static_cast<uint32_t>(lists.tile_first[lists.num_tiles] / num_places + 1)),
          has_parts(lists.num_plans != lists.num_tiles) {}
    __device__ int log2_parts_of(uint32_t count) const {
        if (!has_parts || count <= kPiece || count < share) return 0;
        return count / 2 < share ? 1 : 2;
    }
    __device__ int class_of(uint32_t count) const {
        const uint32_t load = count >> log2_parts_of(count);
        if (load < 2) return kPlanClasses - 1 - static_cast<int>(load);
        const int octave = 31 - __clz(static_cast<int>(load));
        return kPlanClasses - 1 - 2 * octave - static_cast<int>(load >> (octave - 1) & 1);
    }
};

// Counts the plans of each class.
__global__ void __launch_bounds__(kPlanThreads) count_plans_kernel(FrameLists lists, uint32_t num_places) {
    await_kernel_before();
    __shared__ uint32_t in_block[kPlanClasses];
    if (!lists.capacity.holds(*lists.counters)) return;
    const PlanRules rules(lists, num_places);
    if (threadIdx.x < kPlanClasses) in_block[threadIdx.x] = 0;
    __syncthreads();
    const uint32_t tile = blockIdx.x * kPlanThreads + threadIdx.x;
    if (tile < lists.num_tiles) {
        const uint32_t count = count_of(lists, tile);
        atomicAdd(&in_block[rules.class_of(count)], 1u << rules.log2_parts_of(count));
    }
    __syncthreads();
    if (threadIdx.x < kPlanClasses && in_block[threadIdx.x] > 0)
        atomicAdd(&lists.plan_counts[threadIdx.x], in_block[threadIdx.x]);
}

// Writes the plans, those of a class where it begins and behind those of other blocks.
__global__ void __launch_bounds__(kPlanThreads) plan_kernel(FrameLists lists, uint32_t num_places) {
    await_kernel_before();
    __shared__ uint32_t place[kPlanClasses], in_block[kPlanClasses], num_planned;
    static_assert(kPlanClasses == 64, "a lane has two");
    if (!lists.capacity.holds(*lists.counters)) return;
    const PlanRules rules(lists, num_places);
    const uint32_t tile = blockIdx.x * kPlanThreads + threadIdx.x;
    const uint32_t count = tile < lists.num_tiles ? count_of(lists, tile) : 0;
    const int log2_parts = rules.log2_parts_of(count), own_class = rules.class_of(count);
    if (threadIdx.x < kPlanClasses) in_block[threadIdx.x] = 0;
    __syncthreads();
    uint32_t before = 0;  // of the block's
    if (tile < lists.num_tiles) before = atomicAdd(&in_block[own_class], 1u << log2_parts);
    __syncthreads();
    if (threadIdx.x < 32) {
        const uint2 counts = reinterpret_cast<const uint2*>(lists.plan_counts)[threadIdx.x];
        const uint32_t end = warp_prefix(counts.x + counts.y);
        uint32_t* taken = lists.plan_counts + kPlanClasses;
        for (int k = 0; k < 2; ++k) {
            const int c = 2 * threadIdx.x + k;
            place[c] = end - counts.y - (k == 0 ? counts.x : 0);
            if (in_block[c] > 0) place[c] += atomicAdd(&taken[c], in_block[c]);
        }
        if (threadIdx.x == 31) num_planned = end;
    }
    __syncthreads();
    if (tile < lists.num_tiles) {
        TilePlan* plan = lists.plans + place[own_class] + before;
        const uint32_t image = lists.image_of_tile[tile];
        for (int part = 0; part < 1 << log2_parts; ++part)
            plan[part] = {tile, image, 0, 0, 0, uint8_t(part), uint8_t(log2_parts), false, false, 0};
    }
    for (uint32_t i = num_planned + tile; i < lists.num_plans; i += gridDim.x * kPlanThreads)
        lists.plans[i].tile = kNoTile;
}

// Room in the scratch for entries, for the whole block.
__device__ unsigned long long take_scratch(FrameCounters& counters, uint32_t count) {
    __shared__ unsigned long long first;
    if (threadIdx.x == 0) first = atomicAdd(&counters.spread, static_cast<unsigned long long>(count));
    __syncthreads();
    const unsigned long long taken = first;
    __syncthreads();
    return taken;
}

// Entries of a window of a list in windows; a window has up to a bucket more.
constexpr uint32_t kWindowEntries = 3 * kWindow / 4;

__device__ uint32_t num_window_ends(uint32_t count) { return (count + kWindowEntries - 1) / kWindowEntries; }

// Room that a list in windows takes, with the ends of its windows behind it.
__device__ uint32_t room_in_windows(uint32_t count) {
    static_assert(sizeof(TileEntry) == 2 * sizeof(uint32_t), "two ends in the place of an entry");
    return count + num_window_ends(count) / 2 + 1;
}

struct SpreadSpace {
    SpreadShared<kLog2Spread> even;
    uint32_t finer[1 << kLog2Spread];
    TileEntry chunk[1];  // as many as there is room for
};

// Whether a bucket has more entries than that; a counter stands where the next one begins.
__device__ bool has_longer(const uint32_t (&bucket)[1 << kLog2Spread], uint32_t most) {
    bool is_long = false;
    for (uint32_t b = threadIdx.x; b < 1 << kLog2Spread; b += kSpreadThreads)
        is_long = is_long || bucket[b] - (b > 0 ? bucket[b - 1] : 0) > most;
    return __syncthreads_or(is_long);
}

// Windows end where the buckets do that reach every kWindowEntries entries.
__device__ void write_window_ends(const uint32_t (&bucket)[1 << kLog2Spread], uint32_t count,
                                  uint32_t* window_ends) {
    for (uint32_t w = threadIdx.x; w < num_window_ends(count); w += kSpreadThreads) {
        const uint32_t least = min((w + 1) * kWindowEntries, count);
        uint32_t b = 0;  // the first bucket that ends there or behind it
#pragma unroll
        for (uint32_t step = 1u << (kLog2Spread - 1); step > 0; step /= 2)
            if (bucket[b + step - 1] < least) b += step;
        window_ends[w] = bucket[b];
    }
}

// Spreads a list into windows of whole buckets, to a place that has room_in_windows() of it; for a whole
// block. Returns whether there are such windows. Where one step of depth is all of a list, there are none:
// the order within a step depends on where pieces begin, which parts of a tile do not have in common.
__device__ bool spread_into_windows(const TileEntry* from, uint32_t count, TileEntry* to,
                                    SpreadSpace& space) {
    SpreadShared<kLog2Spread>& s = space.even;
    const Buckets buckets = find_buckets<kSpreadThreads>(from, 0, count, false, true, s);
    if (buckets.by_record) {
        __syncthreads();  // before the range is found again
        return false;
    }
    place_buckets<kSpreadThreads>(from, 0, count, buckets, s.bucket, s.warp_sum);
    const FinerBuckets finer = finer_buckets(buckets, s.bucket, count, kLog2Spread);
    spread<kSpreadThreads>(from, to, 0, count, finer, space.finer, s.warp_sum);
    const bool has_windows = !has_longer(space.finer, kWindow - kWindowEntries);
    if (has_windows) write_window_ends(space.finer, count, reinterpret_cast<uint32_t*>(to + count));
    __syncthreads();  // the next list is held where these counters are
    return has_windows;
}

// As spread(), for a list that does not fit into shared memory: `most` entries at a time go through it, so
// that those of a bucket are written side by side.
__device__ void spread_by_chunks(const TileEntry* from, TileEntry* to, uint32_t count, uint32_t most,
                                 const Buckets& buckets, SpreadSpace& space) {
    SpreadShared<kLog2Spread>& s = space.even;
    uint32_t (&of_chunk)[1 << kLog2Spread] = space.finer;
    // Where a bucket begins in the chunk, once its counter stands where the next one does.
    const auto begin_of = [&](uint32_t b) { return b > 0 ? of_chunk[b - 1] : 0; };
    place_buckets<kSpreadThreads>(from, 0, count, buckets, s.bucket, s.warp_sum);
    const uint32_t num_chunks = (count + most - 1) / most, size = (count + num_chunks - 1) / num_chunks;
    for (uint32_t first = 0; first < count; first += size) {
        const uint32_t last = min(first + size, count);
        place_buckets<kSpreadThreads>(from, first, last, buckets, of_chunk, s.warp_sum);
        for_each_entry<kSpreadThreads>(from, first, last, [&](TileEntry e) {
            space.chunk[atomicAdd(&of_chunk[buckets.of(e.key)], 1u)] = e;
        });
        __syncthreads();
        for (uint32_t i = threadIdx.x; i < last - first; i += kSpreadThreads) {
            const TileEntry e = space.chunk[i];
            const uint32_t b = buckets.of(e.key);
            to[s.bucket[b] + i - begin_of(b)] = e;
        }
        __syncthreads();
        for (uint32_t b = threadIdx.x; b < 1 << kLog2Spread; b += kSpreadThreads)
            s.bucket[b] += of_chunk[b] - begin_of(b);
        __syncthreads();
    }
}

// Spreads the list of a plan's tile if it is long; by a whole block. Where it is, if `most_held` entries in
// shared memory are enough, else into the scratch. That of a tile in parts is spread into windows, in the
// scratch, by the block that has the first part.
__device__ void spread_list(const FrameLists& lists, TilePlan& plan, uint32_t count, uint32_t most_held,
                            SpreadSpace& space) {
    static_assert(offsetof(SpreadSpace, finer) % sizeof(TileEntry) == 0, "entries lie where `finer` does");
    SpreadShared<kLog2Spread>& s = space.even;
    auto* held = reinterpret_cast<TileEntry*>(&space.finer);
    if (count <= kPiece || plan.part != 0) return;
    TileEntry* entries = lists.entries + lists.tile_first[plan.tile];
    const bool has_parts = plan.log2_parts > 0, is_held = count <= most_held;
    unsigned long long first_scratch = 0;
    if (has_parts || !is_held) {
        const uint32_t room = has_parts ? room_in_windows(count) : count;
        first_scratch = take_scratch(*lists.counters, room);
        if (first_scratch + room > lists.capacity.spread) return;
    }
    TileEntry* scratch = lists.scratch + first_scratch;
    if (has_parts && spread_into_windows(entries, count, scratch, space)) {
        if (threadIdx.x == 0) {
            plan.in_windows = plan.in_scratch = true;
            plan.first_scratch = first_scratch;
        }
        return;
    }
    Buckets buckets;
    if (is_held) {
        for (uint32_t k = threadIdx.x; k < count; k += kSpreadThreads)
            copy_async(reinterpret_cast<float2*>(held + k), reinterpret_cast<const float2*>(entries + k));
        wait_for_copies();
        __syncthreads();
        buckets = find_buckets<kSpreadThreads>(held, 0, count, true, false, s);
        spread<kSpreadThreads>(held, entries, 0, count, buckets, s.bucket, s.warp_sum);
    } else {
        buckets = find_buckets<kSpreadThreads>(entries, 0, count, true, false, s);
        constexpr size_t kBefore = offsetof(SpreadSpace, chunk) - offsetof(SpreadSpace, finer);
        const uint32_t in_chunk = most_held - kBefore / sizeof(TileEntry);
        spread_by_chunks(entries, scratch, count, in_chunk, buckets, space);
    }
    if (has_longer(s.bucket, kWindow) && is_held && !has_parts)
        first_scratch = take_scratch(*lists.counters, count);
    if (threadIdx.x == 0) {
        plan.in_scratch = !is_held;
        plan.first_scratch = first_scratch;
        plan.lowest = buckets.lowest;
        plan.last_bucket = static_cast<uint16_t>(buckets.last);
        plan.shift = static_cast<uint16_t>(buckets.shift);
    }
}

// Spreads the long lists. A block asks for the next plan as it begins with one; behind the longest it takes
// several at once, most of which have short lists.
__global__ void __launch_bounds__(kSpreadThreads, 2) spread_kernel(FrameLists lists, uint32_t most_held) {
    constexpr uint32_t kShortAtOnce = 16;
    __shared__ uint32_t next_of_block;
    await_kernel_before();
    SpreadSpace& space = *reinterpret_cast<SpreadSpace*>(shared_memory());
    if (!lists.capacity.holds_entries(*lists.counters)) return;
    for (uint32_t i = blockIdx.x, end = i + 1; i < lists.num_plans;) {
        TilePlan& plan = lists.plans[i];
        if (plan.tile == kNoTile) return;
        const uint32_t count = count_of(lists, plan.tile), load = count >> plan.log2_parts;
        if (load < kPiece / kMostParts) return;  // and so are all that follow
        const uint32_t taken = load > kPiece ? 1 : kShortAtOnce;
        const bool is_last = i + 1 == end;
        const uint32_t next = is_last && threadIdx.x == 0 ? gridDim.x + atomicAdd(lists.taken, taken) : 0;
        spread_list(lists, plan, count, most_held, space);
        ++i;
        if (!is_last) continue;
        if (threadIdx.x == 0) next_of_block = next;
        __syncthreads();
        i = next_of_block;
        end = i + taken;
        __syncthreads();  // before the next round writes it
    }
}

template <class Stop>
__global__ void __launch_bounds__(kBlendThreads, kBlocks)
    rasterize_kernel(FrameLists lists, RasterTape tape, Stop stop) {
    await_kernel_before();
    if (blockIdx.x == 0 && threadIdx.x == 0 && lists.report != nullptr) *lists.report = *lists.counters;
    if (!lists.capacity.holds(*lists.counters)) return;
    BlendShared& s = *reinterpret_cast<BlendShared*>(shared_memory());
    if (lists.plans[blockIdx.x].tile == kNoTile) return;
    const int part = lists.plans[blockIdx.x].part;
    const TilePlan& plan = lists.plans[blockIdx.x - part];
    if (part > 0 && !plan.in_windows) return;  // the first blends it all
    const uint32_t own_blocks = blocks_of_part(part, plan.in_windows ? plan.log2_parts : 0);
    const Buckets buckets{plan.lowest, plan.last_bucket, plan.shift, false};
    const FrameImage& image = lists.images[plan.image];
    if (planes_of(lists, image).depth != nullptr)
        blend_tile<true>(lists, tape, plan, buckets, own_blocks, image, stop, s);
    else
        blend_tile<false>(lists, tape, plan, buckets, own_blocks, image, stop, s);
}

// Entries that a block of spread_kernel holds, two of which share a multiprocessor.
uint32_t most_held() {
    const size_t of_two = shared_memory_of_multiprocessor() / 2 - 2048;  // the driver keeps 1024
    return static_cast<uint32_t>((of_two - sizeof(SpreadShared<kLog2Spread>)) / sizeof(TileEntry));
}

uint32_t num_places() { return static_cast<uint32_t>(kBlocks) * num_multiprocessors(); }

}  // namespace

uint32_t most_plans(uint32_t num_tiles) {
    // A tile of one share has one more, of two three more, and there are num_places() shares.
    return num_tiles + (kMostParts - 1) * num_places() / 2 + 1;
}

void rasterize(const FrameLists& lists, const RasterTape* tape, cudaStream_t stream) {
    const unsigned plan_blocks = std::max(blocks_for(lists.num_tiles, kPlanThreads), 1u);
    launch_early("count_plans_kernel", count_plans_kernel, plan_blocks, kPlanThreads, 0, stream, lists,
                 num_places());
    launch_early("plan_kernel", plan_kernel, plan_blocks, kPlanThreads, 0, stream, lists, num_places());
    const uint32_t held = most_held();
    launch_early("spread_kernel", spread_kernel, std::min(2 * num_multiprocessors(), lists.num_tiles),
                 kSpreadThreads, sizeof(SpreadShared<kLog2Spread>) + held * sizeof(TileEntry), stream, lists,
                 held);
    const size_t shared_bytes = lists.has_depth ? sizeof(BlendShared) : offsetof(BlendShared, depth);
    with_stop<float>(lists.min_transmittance, [&](auto stop) {
        launch_early("rasterize_kernel", rasterize_kernel<decltype(stop)>, lists.num_plans, kBlendThreads,
                     shared_bytes, stream, lists, tape == nullptr ? RasterTape{} : *tape, stop);
    });
}

}  // namespace cuda
}  // namespace v3dg
