// Casts rays on CUDA.
//
// A warp projects an item; each lane projects one gaussian of one placement. Atomic
// counters append records and entries to lists, so their order in memory varies from
// run to run. The results do not depend on this order: entries are sorted by tile and
// distance, the hits of a ray by distance, and hits of equal distance in the order of
// the draws.
//
// A block blends a tile, with one thread per ray. It reads the entries of its tile in
// ascending order of their smallest distances. Each ray has a window that stores its
// nearest hits that are not yet blended. A hit is blended as soon as no later entry can
// have a closer hit. If the window is full, the farthest hit is dropped, and the ray is
// only blended up to that hit; another pass over the entries continues from there. So
// the order of hits is exact, although memory is bounded.

#include "rays/rays_cuda.h"

#include <algorithm>
#include <bit>
#include <cub/device/device_radix_sort.cuh>

#include "base/launch.cuh"
#include "base/scan.cuh"
#include "project/sources.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kProjectThreads = 128, kProjectWarps = kProjectThreads / 32;
constexpr unsigned kProjectBlocks = 4;  // resident blocks per multiprocessor
// A lane writes the entries of a record with at most this many tiles. The lanes of the
// warp share the work for larger records.
constexpr uint32_t kFewTiles = 16;
// Distances are coded relative to the smallest distance. A code consists of six bits of
// the exponent and the whole mantissa of a float.
constexpr unsigned kDistanceBits = 29;
constexpr uint32_t kMostDistance = (1u << kDistanceBits) - 1;

// Number of hits in the window of a ray; a power of two.
constexpr unsigned kWindow = 16;
// Number of entries that a block loads at once, one per lane of a warp.
constexpr unsigned kLoaded = 32;
// Size of the block of rays, within a tile, that a warp blends.
constexpr int kWarpColumns = 8, kWarpRows = 4;
static_assert(kWarpColumns * kWarpRows == 32 && kRayTileColumns % kWarpColumns == 0 &&
                  kRayTileRows % kWarpRows == 0,
              "warps divide a tile into rectangles");

// Returns the code of a distance in `bits` bits. Larger distances never have smaller
// codes.
V3DG_HD uint32_t code_of_distance(float distance, float nearest, unsigned bits) {
    const float x = distance > nearest ? distance : nearest;
    uint32_t of_x, of_nearest;
    std::memcpy(&of_x, &x, sizeof x);
    std::memcpy(&of_nearest, &nearest, sizeof nearest);
    const uint32_t difference = of_x - of_nearest;
    return (difference < kMostDistance ? difference : kMostDistance) >> (kDistanceBits - bits);
}

// Returns a lower bound of all distances whose code is at least `code`.
V3DG_HD float distance_of_code(uint32_t code, float nearest, unsigned bits) {
    uint32_t of_nearest;
    std::memcpy(&of_nearest, &nearest, sizeof nearest);
    return float_of_bits(of_nearest + (code << (kDistanceBits - bits)));
}

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
__device__ void write_entries(const RayDirections& rays, const RayTiles& tiles, uint32_t num_tiles,
                              uint32_t first_tile, uint32_t distance, uint32_t record,
                              unsigned long long first, uint32_t before, const RayLists& out) {
    const auto write = [&](const RayTiles& reached, uint32_t k, uint32_t of_image, uint32_t code,
                           uint32_t index, unsigned long long at) {
        const uint32_t key = (of_image + rays.tile(reached, k)) << out.distance_bits | code;
        out.entries[at + k] = uint64_t(key) << 32 | index;
    };
    if (num_tiles <= kFewTiles)
        for (uint32_t k = 0; k < num_tiles; ++k)
            write(tiles, k, first_tile, distance, record, first + before);
    for (unsigned large = __ballot_sync(kAllLanes, num_tiles > kFewTiles); large != 0;
         large &= large - 1) {
        const int owner = __ffs(static_cast<int>(large)) - 1;
        const RayTiles reached{.row = __shfl_sync(kAllLanes, tiles.row, owner),
                               .column = __shfl_sync(kAllLanes, tiles.column, owner),
                               .num_rows = __shfl_sync(kAllLanes, tiles.num_rows, owner),
                               .num_columns = __shfl_sync(kAllLanes, tiles.num_columns, owner)};
        const uint32_t of_image = __shfl_sync(kAllLanes, first_tile, owner);
        const uint32_t code = __shfl_sync(kAllLanes, distance, owner);
        const uint32_t index = __shfl_sync(kAllLanes, record, owner);
        const unsigned long long at = first + __shfl_sync(kAllLanes, before, owner);
        for (uint32_t k = threadIdx.x % 32; k < reached.count(); k += 32)
            write(reached, k, of_image, code, index, at);
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
            uint32_t distance = 0;
            if (is_kept)
                distance = code_of_distance(record.nearest, limits.nearest, out.distance_bits);
            write_entries(rays, tiles, num_reached, image * num_tiles, distance,
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

// Position of a hit in the blending order of a ray.
struct HitKey {
    float range;
    uint32_t order;

    __device__ bool operator<(const HitKey& other) const {
        return range != other.range ? range < other.range : order < other.order;
    }
};

// The windows of a block's rays. Each window is a ring buffer with the nearest hits
// that are not yet blended, in ascending order. Neighbouring threads use neighbouring
// banks of shared memory.
struct Windows {
    float range[kWindow][kRayTileSize], alpha[kWindow][kRayTileSize];
    uint32_t record[kWindow][kRayTileSize];
};

// The window of one ray.
class RayWindow {
  public:
    __device__ RayWindow(Windows& memory, const RayRecord* records)
        : memory_(memory), records_(records) {}

    __device__ unsigned size() const { return size_; }
    __device__ float nearest() const { return memory_.range[at(0)][threadIdx.x]; }
    __device__ TileHit hit(unsigned k) const {
        return {memory_.range[at(k)][threadIdx.x], memory_.alpha[at(k)][threadIdx.x],
                memory_.record[at(k)][threadIdx.x]};
    }
    __device__ HitKey key(unsigned k) const {
        return {memory_.range[at(k)][threadIdx.x],
                __ldg(&records_[memory_.record[at(k)][threadIdx.x]].order)};
    }
    __device__ void drop_nearest() {
        first_ = (first_ + 1) % kWindow;
        --size_;
    }
    __device__ void drop_farthest() { --size_; }
    // Inserts a hit. Precondition: the window is not full.
    __device__ void insert(const TileHit& hit, uint32_t order) {
        unsigned k = size_;
        for (; k > 0; --k) {
            const float before = memory_.range[at(k - 1)][threadIdx.x];
            if (before < hit.range || (before == hit.range && key(k - 1).order < order)) break;
            set(k, this->hit(k - 1));
        }
        set(k, hit);
        ++size_;
    }
    __device__ void clear() { size_ = 0; }

  private:
    __device__ unsigned at(unsigned k) const { return (first_ + k) % kWindow; }
    __device__ void set(unsigned k, const TileHit& hit) {
        memory_.range[at(k)][threadIdx.x] = hit.range;
        memory_.alpha[at(k)][threadIdx.x] = hit.alpha;
        memory_.record[at(k)][threadIdx.x] = hit.record;
    }

    Windows& memory_;
    const RayRecord* records_;
    unsigned first_ = 0, size_ = 0;
};

// The result of a ray while it is blended: either colour and mean range, or returns.
template <bool kReturns>
class RayLight {
  public:
    __device__ RayLight(const ReturnRule& rule) {
        if constexpr (kReturns) returns_.start(rule);
    }
    __device__ void add(const TileHit& hit, const float rgb[3], float transmittance) {
        const float weight = hit.alpha * transmittance;
        if constexpr (kReturns) {
            returns_.add({hit.range, weight, luma_of(rgb)}, transmittance);
        } else {
            for (int c = 0; c < 3; ++c) color_[c] += weight * rgb[c];
            weighted_range_ += weight * hit.range;
        }
    }
    __device__ void write(float alpha, size_t out, const RayPlanes& planes) {
        planes.alpha[out] = alpha;
        if constexpr (kReturns) {
            returns_.finish();
            for (int k = 0; k < kMostReturns; ++k) {
                planes.return_range[k][out] = returns_.found(k).range;
                planes.return_intensity[k][out] = returns_.found(k).intensity;
            }
        } else {
            for (int c = 0; c < 3; ++c) planes.color[3 * out + c] = color_[c];
            planes.range[out] = alpha > 0 ? weighted_range_ / alpha : 0;
        }
    }

  private:
    struct Nothing {};
    std::conditional_t<kReturns, ReturnFinder, Nothing> returns_;
    float color_[3] = {0, 0, 0}, weighted_range_ = 0;
};

// Blends the rays of a tile. Launched with one block per tile and one thread per ray.
template <bool kReturns>
__global__ void __launch_bounds__(kRayTileSize)
    cast_kernel(RayLists lists, const uint64_t* entries, const uint32_t* first, RayDirections rays,
                RayLimits limits, RayPlanes planes) {
    __shared__ Windows windows;
    __shared__ float4 loaded[kLoaded][sizeof(RayRecord) / sizeof(float4)];
    __shared__ uint64_t keys[kLoaded + 1];
    const unsigned num_tiles = static_cast<unsigned>(rays.num_tiles());
    const unsigned image = blockIdx.x / num_tiles, tile = blockIdx.x % num_tiles;
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    constexpr unsigned kWarpsAcross = kRayTileColumns / kWarpColumns;
    const int warp_column = static_cast<int>(tile % rays.tile_columns() * kRayTileColumns +
                                             warp % kWarpsAcross * kWarpColumns);
    const int warp_row = static_cast<int>(tile / rays.tile_columns() * kRayTileRows +
                                          warp / kWarpsAcross * kWarpRows);
    const int column = warp_column + static_cast<int>(lane % kWarpColumns);
    const int row = warp_row + static_cast<int>(lane / kWarpColumns);
    const bool is_ray = column < rays.num_columns() && row < rays.num_rows();
    const float x = rays.elevation_cosine[row] * rays.azimuth_cosine[column];
    const float y = rays.elevation_cosine[row] * rays.azimuth_sine[column];
    const float z = rays.elevation_sine[row];

    const uint32_t begin = first[blockIdx.x], end = first[blockIdx.x + 1];
    const uint32_t code_mask = (1u << lists.distance_bits) - 1;
    const auto bound_of = [&](uint64_t key) {
        return distance_of_code(static_cast<uint32_t>(key >> 32) & code_mask, limits.nearest,
                                lists.distance_bits);
    };
    RayWindow window(windows, lists.records);
    RayLight<kReturns> light(planes.rule);
    float transmittance = 1;
    bool is_over = !is_ray;
    // Hits before `from` are already blended. Hits from `limit` on are left for the
    // next pass.
    HitKey from{-INFINITY, 0}, limit{INFINITY, ~0u};
    bool is_limited = false;

    const auto blend_before = [&](float range) {
        while (window.size() > 0 && window.nearest() < range) {
            const TileHit hit = window.hit(0);
            window.drop_nearest();
            light.add(hit, lists.records[hit.record].color, transmittance);
            transmittance *= 1 - hit.alpha;
            if (!(transmittance < limits.min_transmittance)) continue;
            is_over = true;
            window.clear();
        }
    };
    const auto add_hit = [&](const TileHit& hit, uint32_t order, float bound) {
        const HitKey key{hit.range, order};
        if (key < from || !(key < limit)) {
            is_limited = is_limited || !(key < from);
            return;
        }
        if (window.size() == kWindow) blend_before(bound);
        if (is_over) return;
        if (window.size() == kWindow) {
            is_limited = true;
            const HitKey farthest = window.key(kWindow - 1);
            if (!(key < farthest)) {
                limit = key;
                return;
            }
            limit = farthest;
            window.drop_farthest();
        }
        window.insert(hit, order);
    };

    for (bool is_done = false; !is_done;) {
        for (uint32_t base = begin; base < end; base += kLoaded) {
            if (__syncthreads_and(is_over)) break;
            const uint32_t count = min(kLoaded, end - base);
            if (threadIdx.x <= kLoaded)
                keys[threadIdx.x] =
                    base + threadIdx.x < end ? entries[base + threadIdx.x] : ~uint64_t(0);
            constexpr unsigned kVectors = sizeof(RayRecord) / sizeof(float4);
            for (unsigned v = threadIdx.x; v < count * kVectors; v += kRayTileSize) {
                const auto index = static_cast<uint32_t>(__ldg(entries + base + v / kVectors));
                loaded[v / kVectors][v % kVectors] =
                    reinterpret_cast<const float4*>(lists.records + index)[v % kVectors];
            }
            __syncthreads();
            bool reaches = false;
            if (lane < count) {
                const RayRange& range = reinterpret_cast<const RayRecord*>(loaded[lane])->range;
                const int last = warp_column + kWarpColumns - 1;
                const bool is_in_rows = warp_row <= range.row1 && warp_row + kWarpRows > range.row0;
                const bool is_in_columns =
                    (warp_column <= range.column1 && last >= range.column0) ||
                    warp_column + rays.num_columns() <= range.column1;
                reaches = is_in_rows && is_in_columns;
            }
            unsigned left = __ballot_sync(kAllLanes, reaches);
            if (__all_sync(kAllLanes, is_over)) left = 0;
            for (; left != 0; left &= left - 1) {
                const int e = __ffs(static_cast<int>(left)) - 1;
                const RayRecord& record = *reinterpret_cast<const RayRecord*>(loaded[e]);
                const RayHit<float> hit = hit_of(record.shape, x, y, z);
                const float reach = record.shape.log2_opacity - float(kLog2MinAlpha);
                const bool is_hit = !is_over && hit.falloff <= reach &&
                                    hit.range >= limits.nearest && hit.range <= limits.farthest;
                if (!is_hit) continue;
                const float alpha = min_of(exp2_in_range(record.shape.log2_opacity - hit.falloff),
                                           float(kMaxAlpha));
                add_hit({hit.range, alpha, static_cast<uint32_t>(keys[e])}, record.order,
                        bound_of(keys[e]));
            }
            if (!is_over) blend_before(base + kLoaded < end ? bound_of(keys[kLoaded]) : INFINITY);
        }
        if (!is_over) blend_before(INFINITY);
        is_over = is_over || !is_limited;
        from = limit;
        limit = {INFINITY, ~0u};
        is_limited = false;
        is_done = __syncthreads_and(is_over);
    }
    if (!is_ray) return;
    const size_t out = image * rays.num_rays() + rays.place(row, column);
    light.write(1 - transmittance, out, planes);
}

}  // namespace

unsigned distance_bits_of(size_t num_tiles) {
    const auto tile_bits = static_cast<unsigned>(std::bit_width(num_tiles));
    return std::min(kKeyBits - std::min(tile_bits, kKeyBits - kLeastDistanceBits), kDistanceBits);
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
    const auto end_bit = static_cast<int>(32 + lists.distance_bits + std::bit_width(num_tiles - 1));
    const auto sort = [&](void* scratch, size_t& bytes) {
        check(
            cub::DeviceRadixSort::SortKeys(scratch, bytes, lists.entries, sorted,
                                           static_cast<int64_t>(num_entries), 32, end_bit, stream),
            "sort of rays");
    };
    size_t bytes = 0;
    sort(nullptr, bytes);
    sort(buffers.scratch.reserve(bytes, stream), bytes);
    constexpr unsigned kThreads = 256;
    launch("first_kernel", first_kernel, blocks_for(num_entries + 1, kThreads), kThreads, 0, stream,
           sorted, static_cast<uint32_t>(num_entries), 32 + lists.distance_bits,
           static_cast<uint32_t>(num_tiles), buffers.first.reserve(num_tiles + 1, stream));
}

void cast_rays(const RayLists& lists, const RaySortBuffers& sorted, size_t num_images,
               const RayDirections& rays, const RayLimits& limits, const RayPlanes& planes,
               cudaStream_t stream) {
    const auto blocks = static_cast<unsigned>(num_images * rays.num_tiles());
    launch("cast_kernel", planes.has_returns() ? cast_kernel<true> : cast_kernel<false>, blocks,
           kRayTileSize, 0, stream, lists, sorted.sorted.data(), sorted.first.data(), rays, limits,
           planes);
}

}  // namespace cuda
}  // namespace v3dg
