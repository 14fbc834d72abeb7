// Blends the rays of tiles on CUDA.
//
// A warp blends a tile, with one lane per ray, and reads the entries of the tile in
// ascending order of their lower bounds, one batch after another. A gaussian reaches
// only a few of the 32 rays. So the lanes do not evaluate each gaussian together: the
// boxes of a batch tell each lane which entries may reach its ray, and it evaluates
// only these.
//
// Each ray has a window that stores its nearest hits that are not yet blended. A hit is
// blended as soon as no later entry can have a closer hit. If the window is full, the
// farthest hit is dropped, and the ray is only blended up to that hit; another pass
// over the entries continues from there. So the order of hits is exact, although memory
// is bounded.

#include <cstddef>

#include "base/copy_async.cuh"
#include "base/launch.cuh"
#include "rays/rays_cuda.h"

namespace v3dg {
namespace cuda {

namespace {

// Number of hits in the window of a ray. More need fewer passes, but leave room for
// fewer warps.
constexpr unsigned kWindow = 24;
// Number of entries in a batch: one per lane.
constexpr unsigned kBatch = 32;
// The vectors of a record that are copied to shared memory: all in front of the range.
constexpr unsigned kCopiedVectors = offsetof(RayRecord, range) / sizeof(float4);
static_assert(sizeof(RayRecord) == (kCopiedVectors + 1) * sizeof(float4),
              "the range is the last vector of a record");

// The shared memory of a warp. Neighbouring lanes use neighbouring banks.
struct TileMemory {
    float4 hits[kWindow][32];
    float4 records[kBatch][kCopiedVectors];
    float bounds[kBatch];
    uint32_t indices[kBatch];

    __device__ const RayRecord& record(unsigned k) const {
        return *reinterpret_cast<const RayRecord*>(records[k]);
    }
};

// Position of a hit in the blending order of a ray.
struct HitKey {
    float range;
    uint32_t order;

    __device__ bool operator<(const HitKey& other) const {
        return range != other.range ? range < other.range : order < other.order;
    }
};

// A hit in the window of a ray. `light` is the luma of the gaussian's colour or, where
// colours are blended, the index of the record.
struct WindowHit {
    float range, alpha;
    uint32_t order, light;

    __device__ HitKey key() const { return {range, order}; }
};

// The window of one ray: a ring buffer of hits in ascending order.
class RayWindow {
  public:
    __device__ explicit RayWindow(TileMemory& memory) : memory_(memory) {}

    __device__ unsigned size() const { return size_; }
    __device__ float nearest() const { return memory_.hits[first_][threadIdx.x].x; }
    __device__ WindowHit hit(unsigned k) const { return hit_at(place_of(k)); }
    __device__ void drop_nearest() {
        first_ = first_ + 1 == kWindow ? 0 : first_ + 1;
        --size_;
    }
    __device__ void drop_farthest() { --size_; }
    // Inserts a hit. Precondition: the window is not full.
    __device__ void insert(const WindowHit& hit) {
        unsigned place = place_of(size_);
        for (unsigned k = size_; k > 0; --k) {
            const unsigned lower = place == 0 ? kWindow - 1 : place - 1;
            const WindowHit before = hit_at(lower);
            if (before.key() < hit.key()) break;
            set(place, before);
            place = lower;
        }
        set(place, hit);
        ++size_;
    }
    __device__ void clear() { size_ = 0; }

  private:
    __device__ unsigned place_of(unsigned k) const {
        const unsigned place = first_ + k;
        return place >= kWindow ? place - kWindow : place;
    }
    __device__ WindowHit hit_at(unsigned place) const {
        const float4 v = memory_.hits[place][threadIdx.x];
        return {v.x, v.y, __float_as_uint(v.z), __float_as_uint(v.w)};
    }
    __device__ void set(unsigned place, const WindowHit& hit) {
        memory_.hits[place][threadIdx.x] = {hit.range, hit.alpha, __uint_as_float(hit.order),
                                            __uint_as_float(hit.light)};
    }

    TileMemory& memory_;
    unsigned first_ = 0, size_ = 0;
};

// The result of a ray while it is blended: either colour and mean range, or returns.
template <bool kReturns>
class RayLight {
  public:
    __device__ RayLight(const ReturnRule& rule, const RayRecord* records) : records_(records) {
        if constexpr (kReturns) returns_.start(rule);
    }
    // Returns WindowHit::light of a record.
    static __device__ uint32_t light_of(const RayRecord& record, uint32_t index) {
        if constexpr (kReturns) return __float_as_uint(luma_of(record.color));
        return index;
    }
    __device__ void add(const WindowHit& hit, float transmittance) {
        const float weight = hit.alpha * transmittance;
        if constexpr (kReturns) {
            returns_.add({hit.range, weight, __uint_as_float(hit.light)}, transmittance);
        } else {
            const float* rgb = records_[hit.light].color;
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
    const RayRecord* records_;
    std::conditional_t<kReturns, ReturnFinder, Nothing> returns_;
    float color_[3] = {0, 0, 0}, weighted_range_ = 0;
};

// A ray while it is blended.
template <bool kReturns>
class OpenRay {
  public:
    __device__ OpenRay(TileMemory& memory, const RayRecord* records, const ReturnRule& rule,
                       float min_transmittance, bool exists)
        : window_(memory),
          light_(rule, records),
          min_transmittance_(min_transmittance),
          is_over_(!exists) {}

    __device__ bool is_over() const { return is_over_; }

    // Blends the hits in front of a distance.
    __device__ void blend_before(float distance) {
        while (window_.size() > 0 && window_.nearest() < distance) {
            const WindowHit hit = window_.hit(0);
            window_.drop_nearest();
            light_.add(hit, transmittance_);
            transmittance_ *= 1 - hit.alpha;
            if (!(transmittance_ < min_transmittance_)) continue;
            is_over_ = true;
            window_.clear();
        }
    }
    // Adds a hit. `bound` is a lower bound on the distances of this hit and all later
    // ones.
    __device__ void add(const WindowHit& hit, float bound) {
        const HitKey key = hit.key();
        if (key < from_ || !(key < limit_)) {
            is_limited_ = is_limited_ || !(key < from_);
            return;
        }
        if (window_.size() == kWindow) blend_before(bound);
        if (is_over_) return;
        if (window_.size() == kWindow) {
            is_limited_ = true;
            const HitKey farthest = window_.hit(kWindow - 1).key();
            if (!(key < farthest)) {
                limit_ = key;
                return;
            }
            limit_ = farthest;
            window_.drop_farthest();
        }
        window_.insert(hit);
    }
    // Blends the rest of the window, and prepares another pass over the entries if a
    // hit did not fit. Without one, the ray is over.
    __device__ void end_pass() {
        blend_before(INFINITY);
        is_over_ = is_over_ || !is_limited_;
        from_ = limit_;
        limit_ = {INFINITY, ~0u};
        is_limited_ = false;
    }
    __device__ void write(size_t out, const RayPlanes& planes) {
        light_.write(1 - transmittance_, out, planes);
    }

  private:
    RayWindow window_;
    RayLight<kReturns> light_;
    float transmittance_ = 1;
    float min_transmittance_;
    bool is_over_;
    // Hits before `from_` are blended. Hits from `limit_` on wait for the next pass;
    // `is_limited_` says whether there are any.
    HitKey from_{-INFINITY, 0}, limit_{INFINITY, ~0u};
    bool is_limited_ = false;
};

// Copies the records of a batch to shared memory. Each lane has the entry of one of
// them. All lanes must call it, and wait for each other before and after it.
__device__ void copy_batch(const RayLists& lists, uint64_t entry, unsigned count, float nearest,
                           TileMemory& memory) {
    const unsigned lane = threadIdx.x;
    const uint32_t index = record_of_entry(entry);
    memory.indices[lane] = index;
    memory.bounds[lane] =
        distance_of_code(code_of_entry(entry, lists.distance_bits), nearest, lists.distance_bits);
    constexpr unsigned kLanesEach = 8;
    static_assert(kCopiedVectors <= kLanesEach, "a lane copies at most one vector of a record");
#pragma unroll
    for (unsigned first = 0; first < kBatch; first += 32 / kLanesEach) {
        const unsigned k = first + lane / kLanesEach, v = lane % kLanesEach;
        const uint32_t record = __shfl_sync(kAllLanes, index, static_cast<int>(k));
        if (k < count && v < kCopiedVectors)
            copy_async(&memory.records[k][v],
                       reinterpret_cast<const float4*>(lists.records + record) + v);
    }
    wait_for_copies();
}

// Returns a mask of the lanes whose rays may be hit: those of a tile that begins at
// (first_row, first_column).
__device__ uint32_t lanes_in(const RayRange& range, const RayDirections& rays, int first_row,
                             int first_column) {
    const auto bits = [](int first, int last) {
        return first > last || last < 0 ? 0u : ((2u << last) - 1) & ~((1u << first) - 1);
    };
    const int last = rays.tile_width - 1;
    const uint32_t columns =
        bits(max(range.column0 - first_column, 0), min(range.column1 - first_column, last)) |
        bits(0, min(range.column1 - rays.num_columns() - first_column, last));
    uint32_t lanes = 0;
    for (int r = 0; r < rays.tile_height; ++r)
        if (first_row + r >= range.row0 && first_row + r <= range.row1)
            lanes |= columns << (r * rays.tile_width);
    return lanes;
}

// Transposes a matrix of bits with one row per lane: bit k of the result of lane i is
// bit i of lane k.
__device__ uint32_t transposed(uint32_t row) {
    uint32_t low = 0x0000ffff;
#pragma unroll
    for (unsigned width = 16; width > 0; width /= 2) {
        const uint32_t other = __shfl_xor_sync(kAllLanes, row, static_cast<int>(width));
        row = (threadIdx.x & width) == 0 ? (row & low) | (other & low) << width
                                         : (row & ~low) | (other & ~low) >> width;
        low ^= low << (width / 2);
    }
    return row;
}

// One block of one warp per tile, one lane per ray.
template <bool kReturns>
__global__ void __launch_bounds__(kRaysOfTile)
    cast_kernel(RayLists lists, const uint64_t* entries, const uint32_t* first,
                const uint32_t* order, RayDirections rays, RayLimits limits, RayPlanes planes) {
    __shared__ TileMemory memory;
    const unsigned lane = threadIdx.x;
    const auto num_tiles = static_cast<unsigned>(rays.num_tiles());
    const uint32_t place = order[blockIdx.x];
    const unsigned image = place / num_tiles, tile = place % num_tiles;
    const int first_column = static_cast<int>(tile) % rays.tile_columns() * rays.tile_width;
    const int first_row = static_cast<int>(tile) / rays.tile_columns() * rays.tile_height;
    const int column = first_column + static_cast<int>(lane) % rays.tile_width;
    const int row = first_row + static_cast<int>(lane) / rays.tile_width;
    const bool is_ray = column < rays.num_columns() && row < rays.num_rows();
    const float x = rays.elevation_cosine[row] * rays.azimuth_cosine[column];
    const float y = rays.elevation_cosine[row] * rays.azimuth_sine[column];
    const float z = rays.elevation_sine[row];

    const uint32_t begin = first[place], end = first[place + 1];
    const auto entry_at = [&](uint32_t i) { return i < end ? __ldg(entries + i) : 0; };
    OpenRay<kReturns> ray(memory, lists.records, planes.rule, limits.min_transmittance, is_ray);
    while (!__all_sync(kAllLanes, ray.is_over())) {
        uint64_t next_entry = entry_at(begin + lane);
        for (uint32_t base = begin; base < end; base += kBatch) {
            const uint64_t entry = next_entry;
            const unsigned count = min(kBatch, end - base);
            __syncwarp();
            uint32_t reached = 0;
            if (lane < count)
                reached = lanes_in(lists.records[record_of_entry(entry)].range, rays, first_row,
                                   first_column);
            copy_batch(lists, entry, count, limits.nearest, memory);
            next_entry = entry_at(base + kBatch + lane);
            uint32_t left = transposed(reached);
            __syncwarp();
            if (!ray.is_over()) ray.blend_before(memory.bounds[0]);
            if (__all_sync(kAllLanes, ray.is_over())) break;
            if (ray.is_over()) left = 0;
            while (left != 0) {
                const unsigned k = __ffs(static_cast<int>(left)) - 1;
                left &= left - 1;
                const RayRecord& record = memory.record(k);
                const RayHit<float> hit = hit_of(record.shape, x, y, z);
                const float reach = record.shape.log2_opacity - float(kLog2MinAlpha);
                const bool is_hit = hit.falloff <= reach && hit.range >= limits.nearest &&
                                    hit.range <= limits.farthest;
                if (!is_hit) continue;
                const float alpha = min_of(exp2_in_range(record.shape.log2_opacity - hit.falloff),
                                           float(kMaxAlpha));
                // Rounding must not put a hit in front of the bound of its record.
                const float range = max_of(hit.range, record.nearest);
                const uint32_t light = RayLight<kReturns>::light_of(record, memory.indices[k]);
                ray.add({range, alpha, record.order, light}, memory.bounds[k]);
                if (ray.is_over()) left = 0;
            }
        }
        if (!ray.is_over()) ray.end_pass();
    }
    if (is_ray) ray.write(image * rays.num_rays() + rays.place(row, column), planes);
}

}  // namespace

void cast_rays(const RayLists& lists, const RaySortBuffers& sorted, size_t num_images,
               const RayDirections& rays, const RayLimits& limits, const RayPlanes& planes,
               cudaStream_t stream) {
    const auto blocks = static_cast<unsigned>(num_images * rays.num_tiles());
    launch("cast_kernel", planes.has_returns() ? cast_kernel<true> : cast_kernel<false>, blocks,
           kRaysOfTile, 0, stream, lists, sorted.sorted.data(), sorted.first.data(),
           sorted.order.data(), rays, limits, planes);
}

}  // namespace cuda
}  // namespace v3dg
