// Plans the order in which tiles are blended, and the number of parts of each tile.
// Also spreads long lists over buckets of depth. A list that fits into shared memory is
// spread in place. A longer list is spread into scratch memory, in chunks that fit into
// shared memory. The list of a tile with several parts is spread into windows.

#include "rasterize/spread_lists_cuda.h"

#include <algorithm>

#include "base/copy_async.cuh"
#include "base/launch.cuh"
#include "rasterize/piece_sort.cuh"

namespace v3dg {
namespace cuda {
namespace {

constexpr int kLog2Spread = 11;    // log2 of the maximum number of buckets of a list
constexpr int kPlanThreads = 256;  // one thread per tile
constexpr int kSpreadThreads = 1024;
constexpr int kMostParts = 4;  // maximum number of parts of a tile

static_assert(kPiece % (3 * kMostParts) == 0 && (kPiece / 3 & (kPiece / 3 - 1)) == 0,
              "kPiece and kPiece / kMostParts must be the lowest loads of classes");

__device__ uint32_t count_of(const FrameLists& lists, uint32_t tile) {
    return static_cast<uint32_t>(lists.tile_first[tile + 1] - lists.tile_first[tile]);
}

// The rules of planning. Plans are ordered by descending load, so that no block starts
// a long list at the end. Loads are grouped into classes that span less than half an
// octave; within a class, the order is arbitrary.
//
// If a few tiles have most of the entries, they are divided into parts. This happens
// when an asset fills only the middle of a picture. A block blends one part, and drops
// the entries of other parts. `num_places` blocks run concurrently, and no block should
// get much more than its share of the load.
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
    // Returns the smallest load of a plan whose list may be longer than kPiece. Plans
    // after the first one with a smaller load have no such list: a part has at least
    // half a share of the load, and the loads of a class differ by less than half of
    // the smallest one.
    __device__ uint32_t least_of_long() const {
        constexpr uint32_t kLongest = kPiece, kLeastOfPart = kPiece / kMostParts;
        return has_parts ? max(min(share / 3, kLongest), kLeastOfPart) : kLongest;
    }
};

// Counts the plans of each class. Launched with one thread per tile.
__global__ void __launch_bounds__(kPlanThreads)
    count_plans_kernel(FrameLists lists, uint32_t num_places) {
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

// Writes the plans. Launched with one thread per tile. The plans of a class are
// contiguous.
__global__ void __launch_bounds__(kPlanThreads) plan_kernel(FrameLists lists, uint32_t num_places) {
    await_kernel_before();
    __shared__ uint32_t place[kPlanClasses], in_block[kPlanClasses], num_planned;
    static_assert(kPlanClasses == 64, "each lane of a warp processes two classes");
    if (!lists.capacity.holds(*lists.counters)) return;
    const PlanRules rules(lists, num_places);
    const uint32_t tile = blockIdx.x * kPlanThreads + threadIdx.x;
    const uint32_t count = tile < lists.num_tiles ? count_of(lists, tile) : 0;
    const int log2_parts = rules.log2_parts_of(count), own_class = rules.class_of(count);
    if (threadIdx.x < kPlanClasses) in_block[threadIdx.x] = 0;
    __syncthreads();
    // Number of plans of this class that belong to earlier tiles of the block.
    uint32_t before = 0;
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
            plan[part] = {.tile = tile,
                          .image = image,
                          .lowest = 0,
                          .last_bucket = 0,
                          .shift = 0,
                          .part = uint8_t(part),
                          .log2_parts = uint8_t(log2_parts),
                          .in_windows = false,
                          .in_scratch = false,
                          .first_scratch = 0};
    }
    for (uint32_t i = num_planned + tile; i < lists.num_plans; i += gridDim.x * kPlanThreads)
        lists.plans[i].tile = kNoTile;
}

// Allocates entries in scratch memory. All threads of the block must call it.
__device__ unsigned long long take_scratch(FrameCounters& counters, uint32_t count) {
    __shared__ unsigned long long first;
    if (threadIdx.x == 0)
        first = atomicAdd(&counters.spread, static_cast<unsigned long long>(count));
    __syncthreads();
    const unsigned long long taken = first;
    __syncthreads();
    return taken;
}

// Minimum number of entries in a window. Windows consist of whole buckets, so they may
// be longer by up to one bucket.
constexpr uint32_t kWindowEntries = 3 * kWindow / 4;

__device__ uint32_t num_window_ends(uint32_t count) {
    return (count + kWindowEntries - 1) / kWindowEntries;
}

// Returns the number of entries to allocate for a list that is spread into windows. The
// ends of its windows are stored after the list.
__device__ uint32_t room_in_windows(uint32_t count) {
    static_assert(sizeof(TileEntry) == 2 * sizeof(uint32_t),
                  "two ends of windows occupy the memory of an entry");
    return count + num_window_ends(count) / 2 + 1;
}

struct SpreadSpace {
    SpreadShared<kLog2Spread> even;
    uint32_t finer[1 << kLog2Spread];
    TileEntry chunk[1];  // continues to the end of the shared memory
};

// Returns whether any bucket has more than `most` entries. bucket[b] must hold the
// first index of the bucket after b.
__device__ bool has_longer(const uint32_t (&bucket)[1 << kLog2Spread], uint32_t most) {
    bool is_long = false;
    for (uint32_t b = threadIdx.x; b < 1 << kLog2Spread; b += kSpreadThreads)
        is_long = is_long || bucket[b] - (b > 0 ? bucket[b - 1] : 0) > most;
    return __syncthreads_or(is_long);
}

// Writes the ends of windows. A window ends with the bucket that contains the next
// multiple of kWindowEntries.
__device__ void write_window_ends(const uint32_t (&bucket)[1 << kLog2Spread], uint32_t count,
                                  uint32_t* window_ends) {
    for (uint32_t w = threadIdx.x; w < num_window_ends(count); w += kSpreadThreads) {
        const uint32_t least = min((w + 1) * kWindowEntries, count);
        uint32_t b = 0;  // first bucket that ends at `least` or later
#pragma unroll
        for (uint32_t step = 1u << (kLog2Spread - 1); step > 0; step /= 2)
            if (bucket[b + step - 1] < least) b += step;
        window_ends[w] = bucket[b];
    }
}

// Spreads a list into windows of whole buckets. `to` must have room for
// room_in_windows() entries. All threads of the block must call it.
//
// Returns false if the list cannot be divided into windows, because a bucket is too
// long or all entries have the same rounded depth. For such lists, the order of equal
// depths depends on where pieces begin, and this differs between the parts of a tile.
__device__ bool spread_into_windows(const TileEntry* from, uint32_t count, TileEntry* to,
                                    SpreadSpace& space) {
    SpreadShared<kLog2Spread>& s = space.even;
    const Buckets buckets = find_buckets<kSpreadThreads>(from, 0, count, false, true, s);
    if (buckets.by_order) {
        __syncthreads();  // the next find_buckets() overwrites the range
        return false;
    }
    place_buckets<kSpreadThreads>(from, 0, count, buckets, s.bucket, s.warp_sum);
    const FinerBuckets finer = finer_buckets(buckets, s.bucket, count, kLog2Spread);
    spread<kSpreadThreads>(from, to, 0, count, finer, space.finer, s.warp_sum);
    const bool has_windows = !has_longer(space.finer, kWindow - kWindowEntries);
    if (has_windows) write_window_ends(space.finer, count, reinterpret_cast<uint32_t*>(to + count));
    __syncthreads();  // the next list overwrites the counters
    return has_windows;
}

// The number of entries of a list per chunk and bucket. Each word holds two 16-bit
// counts.
struct ChunkCounts {
    uint32_t* words;
    uint32_t stride;  // words per chunk

    __device__ void add(uint32_t chunk, uint32_t bucket) const {
        atomicAdd(&words[chunk * stride + bucket / 2], 1u << 16 * (bucket % 2));
    }
    __device__ uint32_t of(uint32_t chunk, uint32_t bucket) const {
        return words[chunk * stride + bucket / 2] >> 16 * (bucket % 2) & 0xffff;
    }
};

// Like spread(), but for a list that does not fit into shared memory. The list is
// processed in chunks, so that the entries of a bucket are written contiguously. Shared
// memory holds `most` entries: one chunk and, if there are few chunks, the counts of
// all chunks. If these counts do not fit, each chunk is counted when it is read.
__device__ void spread_by_chunks(const TileEntry* from, TileEntry* to, uint32_t count,
                                 uint32_t most, const Buckets& buckets, SpreadSpace& space) {
    SpreadShared<kLog2Spread>& s = space.even;
    uint32_t (&of_chunk)[1 << kLog2Spread] = space.finer;
    TileEntry* chunk = space.chunk;
    const uint32_t num_buckets = buckets.last + 1;
    // Shared memory for the counts of one chunk, in entries: an entry has room for four
    // counts of 16 bits.
    const uint32_t counts_room = num_buckets / 4;
    uint32_t num_chunks = 1;
    const auto size_of_chunk = [&] { return (count + num_chunks - 1) / num_chunks; };
    const auto has_room = [&] { return size_of_chunk() + num_chunks * counts_room <= most; };
    while (!has_room() && num_chunks * counts_room < most) ++num_chunks;
    const bool are_counted = has_room();
    if (!are_counted) num_chunks = (count + most - 1) / most;
    const uint32_t size = size_of_chunk();
    const ChunkCounts counts{reinterpret_cast<uint32_t*>(chunk + size), num_buckets / 2};
    if (are_counted) {
        for (uint32_t i = threadIdx.x; i < num_chunks * counts.stride; i += kSpreadThreads)
            counts.words[i] = 0;
        __syncthreads();
        for (uint32_t k = 0; k < num_chunks; ++k)
            for_each_entry<kSpreadThreads>(from, k * size, min((k + 1) * size, count),
                                           [&](TileEntry e) { counts.add(k, buckets.of(e.key)); });
        __syncthreads();
        for (uint32_t b = threadIdx.x; b < 1 << kLog2Spread; b += kSpreadThreads) {
            uint32_t sum = 0;
            for (uint32_t k = 0; b < num_buckets && k < num_chunks; ++k) sum += counts.of(k, b);
            s.bucket[b] = sum;
        }
        __syncthreads();
        scan_buckets<1 << kLog2Spread, kSpreadThreads>(s.bucket, s.warp_sum);
    } else {
        place_buckets<kSpreadThreads>(from, 0, count, buckets, s.bucket, s.warp_sum);
    }

    // Returns the index in the chunk at which bucket b begins. This works only after
    // all entries are placed, which advances of_chunk[b] from the beginning of bucket b
    // to its end. That end is the beginning of bucket b + 1.
    const auto begin_of = [&](uint32_t b) { return b > 0 ? of_chunk[b - 1] : 0; };
    for (uint32_t k = 0; k < num_chunks; ++k) {
        const uint32_t first = k * size, last = min(first + size, count);
        if (are_counted) {
            for (uint32_t b = threadIdx.x; b < 1 << kLog2Spread; b += kSpreadThreads)
                of_chunk[b] = b < num_buckets ? counts.of(k, b) : 0;
            __syncthreads();
            scan_buckets<1 << kLog2Spread, kSpreadThreads>(of_chunk, s.warp_sum);
        } else {
            place_buckets<kSpreadThreads>(from, first, last, buckets, of_chunk, s.warp_sum);
        }
        for_each_entry<kSpreadThreads>(from, first, last, [&](TileEntry e) {
            chunk[atomicAdd(&of_chunk[buckets.of(e.key)], 1u)] = e;
        });
        __syncthreads();
        for (uint32_t i = threadIdx.x; first + i < last; i += kSpreadThreads) {
            const TileEntry e = chunk[i];
            const uint32_t b = buckets.of(e.key);
            to[s.bucket[b] + i - begin_of(b)] = e;
        }
        __syncthreads();
        for (uint32_t b = threadIdx.x; b < 1 << kLog2Spread; b += kSpreadThreads)
            s.bucket[b] += of_chunk[b] - begin_of(b);
        __syncthreads();
    }
}

// Spreads the list of a plan's tile if it is longer than a piece. All threads of the
// block must call it. A list of at most `most_held` entries fits into shared memory,
// and is spread in place. A longer list is spread into scratch memory. The list of a
// tile with several parts is spread into windows in scratch memory, once, by the block
// of the first part.
__device__ void spread_list(const FrameLists& lists, TilePlan& plan, uint32_t count,
                            uint32_t most_held, SpreadSpace& space) {
    static_assert(offsetof(SpreadSpace, finer) % sizeof(TileEntry) == 0,
                  "entries share the memory of `finer`, so it must be aligned for them");
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
            copy_async(reinterpret_cast<float2*>(held + k),
                       reinterpret_cast<const float2*>(entries + k));
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

// Spreads long lists. A block claims its next plan when it starts the current one,
// which hides the latency of the atomic operation.
__global__ void __launch_bounds__(kSpreadThreads, 2)
    spread_kernel(FrameLists lists, uint32_t most_held, uint32_t num_places) {
    __shared__ uint32_t next_of_block;
    await_kernel_before();
    SpreadSpace& space = *reinterpret_cast<SpreadSpace*>(shared_memory());
    if (!lists.capacity.holds_entries(*lists.counters)) return;
    const uint32_t least = PlanRules(lists, num_places).least_of_long();
    for (uint32_t i = blockIdx.x; i < lists.num_plans;) {
        TilePlan& plan = lists.plans[i];
        if (plan.tile == kNoTile) return;
        const uint32_t count = count_of(lists, plan.tile);
        if (count >> plan.log2_parts < least) return;
        const uint32_t next = threadIdx.x == 0 ? gridDim.x + atomicAdd(lists.taken, 1u) : 0;
        spread_list(lists, plan, count, most_held, space);
        if (threadIdx.x == 0) next_of_block = next;
        __syncthreads();
        i = next_of_block;
        __syncthreads();  // the next iteration overwrites next_of_block
    }
}

// Returns the number of entries that fit into the shared memory of a block of
// spread_kernel. Two blocks share a multiprocessor.
uint32_t most_held() {
    // The driver reserves 1024 bytes per block.
    const size_t of_two = shared_memory_of_multiprocessor() / 2 - 2048;
    return static_cast<uint32_t>((of_two - sizeof(SpreadShared<kLog2Spread>)) / sizeof(TileEntry));
}

}  // namespace

uint32_t most_plans(uint32_t num_tiles, uint32_t num_places) {
    // A tile with at least one share of the load is divided into two parts, and a tile
    // with at least two shares into four. There are num_places shares, which limits the
    // number of plans.
    return num_tiles + (kMostParts - 1) * num_places / 2 + 1;
}

void spread_lists(const FrameLists& lists, uint32_t num_places, cudaStream_t stream) {
    const unsigned plan_blocks = std::max(blocks_for(lists.num_tiles, kPlanThreads), 1u);
    launch_early("count_plans_kernel", count_plans_kernel, plan_blocks, kPlanThreads, 0, stream,
                 lists, num_places);
    launch_early("plan_kernel", plan_kernel, plan_blocks, kPlanThreads, 0, stream, lists,
                 num_places);
    const uint32_t held = most_held();
    launch_early("spread_kernel", spread_kernel,
                 std::min(2 * num_multiprocessors(), lists.num_tiles), kSpreadThreads,
                 sizeof(SpreadShared<kLog2Spread>) + held * sizeof(TileEntry), stream, lists, held,
                 num_places);
}

}  // namespace cuda
}  // namespace v3dg
