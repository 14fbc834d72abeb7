// Projects gaussians to rays on CUDA, and sorts them into tiles. cast_rays_cuda.cu
// blends them.
//
// A warp projects an item; each lane projects one gaussian of one placement. Atomic
// counters append records and entries to lists, so their order in memory varies from
// run to run. The results do not depend on this order: entries are sorted by tile and
// distance, the hits of a ray by distance, and hits of equal distance in the order of
// the draws.

#include "rays/rays_cuda.h"

#include <algorithm>
#include <bit>
#include <cub/device/device_radix_sort.cuh>

#include "base/launch.cuh"
#include "base/scan.cuh"
#include "project/sources.cuh"
#include "rays/ray_entry.h"
#include "rays/tile_bound.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kProjectThreads = 128, kProjectWarps = kProjectThreads / 32;
constexpr unsigned kProjectBlocks = 4;  // resident blocks per multiprocessor
// A lane writes the entries of a record with at most this many tiles. The lanes of the
// warp share the work for larger records.
constexpr uint32_t kFewTiles = 16;
// Loads gaussians that are stored as rows of floats.
struct RowReader {
    using Model = GaussianRows<const float>;

    static __device__ bool has(const Model& m) { return m.means != nullptr; }
    static __device__ uint32_t cluster_of(const Model&, const DrawItem&, uint32_t) { return 0; }
    static __device__ Gaussian3d<float> load(const Model& m, uint32_t, uint32_t g, float[3]) {
        const float4 quat = load4(m.quats, g);
        Gaussian3d<float> gaussian{
            {}, {quat.x, quat.y, quat.z, quat.w}, {}, __ldg(m.opacities + g)};
        for (int k = 0; k < 3; ++k) {
            gaussian.mean[k] = __ldg(m.means + 3 * size_t(g) + k);
            gaussian.scale[k] = __ldg(m.scales + 3 * size_t(g) + k);
        }
        return gaussian;
    }
    static __device__ void shade(const Model& m, const ModelView<float>& view, uint32_t, uint32_t g,
                                 const float mean[3], float color[3]) {
        const float* sh = m.sh + 3 * size_t(g);  // used only for degree 0
        if (m.sh_degree == 0)
            color_of_row<0>(sh, mean, view, color);
        else if (m.sh_degree == kPlainColor)
            color_of_row<kPlainColor>(sh, mean, view, color);
        else
            RowSource::shade(m, view, {}, g, color);
    }
};

// Loads gaussians that are stored as quantisation codes.
struct CodeReader {
    using Model = CodedGaussians;

    static __device__ bool has(const Model& m) { return m.codes.records != nullptr; }
    // Returns the cluster that contains row `g` of the item.
    static __device__ uint32_t cluster_of(const Model& m, const DrawItem& item, uint32_t g) {
        uint32_t cluster = item.cluster;
        while (g >= static_cast<uint32_t>(__ldg(m.codes.offset.data + cluster + 1))) ++cluster;
        return cluster;
    }
    // Loads a gaussian. Unlike RowReader, it also sets the SH coefficients of degree 0.
    static __device__ Gaussian3d<float> load(const Model& m, uint32_t cluster, uint32_t g,
                                             float sh[3]) {
        return CodeSource::decoded(m, cluster, CodeSource::fetch(m, g), sh);
    }
    static __device__ void shade(const Model& m, const ModelView<float>& view, uint32_t cluster,
                                 uint32_t g, const float mean[3], float color[3]) {
        if (m.codes.sh_degree > 0) {
            CodeSource::shade(m, view, {cluster, 0}, g, color);
            return;
        }
        const float sh[3] = {color[0], color[1], color[2]};
        color_of_sh(0, mean, sh, color);
    }
};

__device__ void store_record(const RayRecord& record, RayRecord* to) {
    static_assert(sizeof(RayRecord) % sizeof(float4) == 0, "records are copied as vectors");
    const auto* from = reinterpret_cast<const float4*>(&record);
#pragma unroll
    for (unsigned k = 0; k < sizeof(RayRecord) / sizeof(float4); ++k)
        reinterpret_cast<float4*>(to)[k] = from[k];
}

// Returns the sum over the lower lanes of the warp. `total` receives the sum over all
// lanes.
__device__ uint32_t sum_before(uint32_t value, uint32_t& total) {
    const uint32_t sum = warp_prefix(value);
    total = __shfl_sync(kAllLanes, sum, 31);
    return sum - value;
}

// Adds to the counters, and returns their previous values in every lane.
__device__ RayListCounts add_to(RayListCounts* counts, uint32_t records, uint32_t entries) {
    unsigned long long before = 0;
    if (threadIdx.x % 32 == 0)
        before = atomicAdd(&counts->both,
                           static_cast<unsigned long long>(entries) << kRecordBits | records);
    return {__shfl_sync(kAllLanes, before, 0)};
}

// Writes the entries of the lanes' records. `before` is the number of entries of lower
// lanes. All lanes of the warp must call it; a lane without a record passes an empty
// range of tiles.
__device__ void write_entries(const RayRecord& record, const RayDirections& rays,
                              const RayTiles& tiles, uint32_t num_tiles, uint32_t first_tile,
                              float nearest, uint32_t index, unsigned long long first,
                              uint32_t before, const RayLists& out) {
    const auto write = [&](const RayTiles& reached, uint32_t k, uint32_t of_image, float distance,
                           uint32_t of_record, unsigned long long at) {
        const uint32_t code = code_of_distance(distance, nearest, out.distance_bits);
        const uint32_t tile = of_image + rays.tile(reached, k);
        out.entries[at + k] = entry_of(tile, code, out.distance_bits, of_record);
    };
    if (num_tiles <= kFewTiles)
        for (uint32_t k = 0; k < num_tiles; ++k) {
            const RayRange part = rays_in_tile(rays, record.range, tiles, k);
            const float bound = nearest_in_tile(record.shape, rays, part);
            write(tiles, k, first_tile, max_of(record.nearest, bound), index, first + before);
        }
    for (unsigned large = __ballot_sync(kAllLanes, num_tiles > kFewTiles); large != 0;
         large &= large - 1) {
        const int owner = __ffs(static_cast<int>(large)) - 1;
        const RayTiles reached{.row = __shfl_sync(kAllLanes, tiles.row, owner),
                               .column = __shfl_sync(kAllLanes, tiles.column, owner),
                               .num_rows = __shfl_sync(kAllLanes, tiles.num_rows, owner),
                               .num_columns = __shfl_sync(kAllLanes, tiles.num_columns, owner)};
        const uint32_t of_image = __shfl_sync(kAllLanes, first_tile, owner);
        const float distance = __shfl_sync(kAllLanes, record.nearest, owner);
        const uint32_t of_record = __shfl_sync(kAllLanes, index, owner);
        const unsigned long long at = first + __shfl_sync(kAllLanes, before, owner);
        for (uint32_t k = threadIdx.x % 32; k < reached.count(); k += 32)
            write(reached, k, of_image, distance, of_record, at);
    }
}

template <class Reader>
__global__ void __launch_bounds__(kProjectThreads, kProjectBlocks)
    project_kernel(RayInput in, const typename Reader::Model* models, RayDirections rays,
                   RayLimits limits, RayLists out) {
    if (!in.items.is_complete()) return;
    const unsigned lane = threadIdx.x % 32;
    const auto num_items = static_cast<uint32_t>(in.items.counters->items);
    const auto num_tiles = static_cast<uint32_t>(rays.num_tiles());
    for (uint32_t i = blockIdx.x * kProjectWarps + threadIdx.x / 32; i < num_items;
         i += gridDim.x * kProjectWarps) {
        const DrawItem item = in.items.items[i];
        const unsigned sharers = item.sharers == 0 ? 1u : item.sharers;
        const uint32_t num_sharers = __popc(sharers), count = item.count * num_sharers;
        const Placement* placed = in.placements + item.placement;
        const typename Reader::Model& model =
            models[placed[__ffs(static_cast<int>(sharers)) - 1].model];
        if (!Reader::has(model)) continue;
        const uint32_t image = placed[__ffs(static_cast<int>(sharers)) - 1].image;
        if (lane == 0)
            atomicAdd(&in.image_counts[image].gaussians, static_cast<unsigned long long>(count));
        const float filter_rad2 = item.appearance.filter_px2 * limits.spacing * limits.spacing;
        for (uint32_t first = 0; first < count; first += 32) {
            const uint32_t k = first + lane;
            bool is_kept = k < count;
            RayRecord record;
            RayTiles tiles{};
            uint32_t num_reached = 0;
            if (is_kept) {
                const uint32_t g = item.first + k / num_sharers;
                const unsigned sharer =
                    item.sharers == 0 ? 0
                                      : __fns(sharers, 0, static_cast<int>(k % num_sharers) + 1);
                const ModelView<float>& view = placed[sharer].view;
                const uint32_t cluster = Reader::cluster_of(model, item, g);
                const Gaussian3d<float> gaussian = Reader::load(model, cluster, g, record.color);
                SeenGaussian<float> seen =
                    see_gaussian(gaussian, view, filter_rad2, item.appearance.antialiased,
                                 item.appearance.is_limited);
                const InstanceFactors* factors =
                    in.factors == nullptr ? nullptr : in.factors_of(item) + sharer;
                const float weight =
                    factors == nullptr ? item.weight : item.weight * factors->opacity;
                if (weight < 1) seen.log2_opacity += log2_of(weight);
                const float reach2 = (seen.log2_opacity - float(kLog2MinAlpha)) *
                                     float(1 / (kFalloffScale * kFalloffScale));
                is_kept = is_visible(seen, gaussian.opacity);
                if (is_kept) {
                    record.nearest = nearest_of(seen, reach2);
                    record.range = rays.range_of(directions_of(seen, reach2));
                    is_kept = record.nearest <= limits.farthest && !record.range.is_empty();
                }
                if (is_kept) {
                    record.shape = shape_on_rays(seen);
                    record.order = item.record + k;
                    Reader::shade(model, view, cluster, g, gaussian.mean, record.color);
                    if (factors != nullptr) tint(factors->color, record.color);
                    tiles = rays.tiles_of(record.range);
                    num_reached = tiles.count();
                }
            }
            const unsigned kept = __ballot_sync(kAllLanes, is_kept);
            if (kept == 0) continue;
            uint32_t num_entries;
            const uint32_t before = sum_before(num_reached, num_entries);
            const RayListCounts counts =
                add_to(out.counts, static_cast<uint32_t>(__popc(kept)), num_entries);
            const unsigned long long at = counts.records() + __popc(kept & ((1u << lane) - 1));
            if (is_kept && at < out.record_capacity) store_record(record, out.records + at);
            if (counts.entries() + num_entries > out.entry_capacity) continue;
            write_entries(record, rays, tiles, num_reached, image * num_tiles, limits.nearest,
                          static_cast<uint32_t>(at), counts.entries(), before, out);
        }
    }
}

// Writes the index of the first entry of each tile. There is one thread per entry, and
// one more for the end of the list.
__global__ void first_kernel(const uint64_t* entries, uint32_t count, unsigned shift,
                             uint32_t num_tiles, uint32_t* first) {
    const uint32_t i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i > count) return;
    const uint32_t before = i == 0 ? 0 : static_cast<uint32_t>(entries[i - 1] >> shift) + 1;
    const uint32_t tile = i == count ? num_tiles : static_cast<uint32_t>(entries[i] >> shift);
    for (uint32_t t = before; t <= tile; ++t) first[t] = i;
}

// Lists of similar lengths are in one class: the lengths up to 3, and four classes for
// each power of two.
constexpr unsigned kLengthClasses = 128;
constexpr unsigned kOrderThreads = 1024;

// Returns the class of a list, 0 for the longest ones.
__device__ unsigned class_of_length(uint32_t length) {
    if (length < 4) return kLengthClasses - 1 - length;
    const auto exponent = static_cast<unsigned>(31 - __clz(static_cast<int>(length)));
    const unsigned mantissa = length >> (exponent - 2) & 3;
    return kLengthClasses - 1 - (4 * (exponent - 1) + mantissa);
}

// Orders tiles by the classes of their lists, in one block. The blocks that blend start
// in this order, so that no long list is left to the end. The order within a class
// varies from run to run.
__global__ void __launch_bounds__(kOrderThreads)
    order_kernel(const uint32_t* first, uint32_t num_tiles, uint32_t* order) {
    __shared__ uint32_t next[kLengthClasses];
    if (threadIdx.x < kLengthClasses) next[threadIdx.x] = 0;
    __syncthreads();
    for (uint32_t tile = threadIdx.x; tile < num_tiles; tile += kOrderThreads)
        atomicAdd(&next[class_of_length(first[tile + 1] - first[tile])], 1u);
    __syncthreads();
    uint32_t total;
    const uint32_t before =
        block_prefix(threadIdx.x < kLengthClasses ? next[threadIdx.x] : 0u, total);
    if (threadIdx.x < kLengthClasses) next[threadIdx.x] = before;
    __syncthreads();
    for (uint32_t tile = threadIdx.x; tile < num_tiles; tile += kOrderThreads)
        order[atomicAdd(&next[class_of_length(first[tile + 1] - first[tile])], 1u)] = tile;
}

}  // namespace

unsigned distance_bits_of(size_t num_tiles) {
    const auto tile_bits = static_cast<unsigned>(std::bit_width(num_tiles));
    const unsigned left = kSortedBits - std::min(tile_bits, kSortedBits);
    return std::clamp(left, kLeastDistanceBits, kDistanceBits);
}

void project_to_rays(const RayInput& in, const RayDirections& rays, const RayLimits& limits,
                     const RayLists& out, cudaStream_t stream) {
    const unsigned blocks = kProjectBlocks * num_multiprocessors();
    if (in.rows != nullptr)
        launch("project_kernel of rays", project_kernel<RowReader>, blocks, kProjectThreads, 0,
               stream, in, in.rows, rays, limits, out);
    if (in.coded != nullptr)
        launch("project_kernel of rays", project_kernel<CodeReader>, blocks, kProjectThreads, 0,
               stream, in, in.coded, rays, limits, out);
}

void sort_entries(const RayLists& lists, size_t num_entries, size_t num_tiles,
                  RaySortBuffers& buffers, cudaStream_t stream) {
    uint64_t* sorted = buffers.sorted.reserve(lists.entry_capacity, stream);
    const auto end_bit =
        static_cast<int>(kRecordBits + lists.distance_bits + std::bit_width(num_tiles - 1));
    const auto sort = [&](void* scratch, size_t& bytes) {
        check(cub::DeviceRadixSort::SortKeys(scratch, bytes, lists.entries, sorted,
                                             static_cast<int64_t>(num_entries),
                                             static_cast<int>(kRecordBits), end_bit, stream),
              "sort of rays");
    };
    size_t bytes = 0;
    sort(nullptr, bytes);
    sort(buffers.scratch.reserve(bytes, stream), bytes);
    constexpr unsigned kThreads = 256;
    launch("first_kernel", first_kernel, blocks_for(num_entries + 1, kThreads), kThreads, 0, stream,
           sorted, static_cast<uint32_t>(num_entries), kRecordBits + lists.distance_bits,
           static_cast<uint32_t>(num_tiles), buffers.first.reserve(num_tiles + 1, stream));
    launch("order_kernel", order_kernel, 1, kOrderThreads, 0, stream, buffers.first.data(),
           static_cast<uint32_t>(num_tiles), buffers.order.reserve(num_tiles, stream));
}

}  // namespace cuda
}  // namespace v3dg
