// A block, or a team of blocks, fits a group, start to end, then takes the next from a queue.
//
// One step: threads project gaussians and order them by depth; half-warps take cells of 4 x 4 pixels, list
// the gaussians that reach them, blend them front to back, compare, and walk back; what a gaussian gets from
// each cell has its own slot, and slots are added up in a fixed order; threads carry that on to the
// parameters, and Adam moves them. So every run has the same result, whatever order blocks and warps come in.
//
// Small groups keep what is read again and again in shared memory. A block fits one or, where there are few,
// a pair of blocks, each looking at every other view. Large groups lie in global memory, and are fitted by
// teams where there are fewer groups than multiprocessors.

#include "fit_group/fit_group_cuda.h"

#include <algorithm>
#include <cfloat>
#include <stdexcept>
#include <type_traits>

#include "base/scan.cuh"
#include "frame/record.cuh"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr int kViewsAtOnce = 2;
// A half-warp blends a cell. Masks have a bit for each cell of a region; a larger picture takes several
// regions.
constexpr int kCell = 4, kCellPixels = kCell * kCell;
constexpr int kRegion = 32, kRegionCells = kRegion / kCell;
static_assert(kRegionCells * kRegionCells == 64 && kCellPixels == 16, "a mask is a word, a cell half a warp");
using CellMask = unsigned long long;
constexpr int kAtOnce = 4;  // gaussians that a half-warp looks at together
constexpr int kSums = 9;    // FalloffSums and colour
constexpr int kSumStride = 12;
constexpr uint32_t kHiddenKey = 0xfffffffeu;  // after all depths
constexpr uint32_t kSmallCount = 256;         // gaussians of a small group, whose picture is one region
constexpr int kStepsPerPoll = 16;
constexpr unsigned kLargestTeam = 16;

// Where an array lies: in the block's shared memory, or in the team's part of the scratch.
struct Place {
    size_t offset;
    bool is_shared;
};

struct Layout {
    // Shared for small groups, in the scratch for large ones.
    size_t records, sorted, keys, mask, slot_first, order, lists, errors;
    size_t list_size;          // bytes, of a half-warp
    size_t fragments, staged;  // shared
    // Wherever there is room.
    Place value, m, v, by_view, sum, sort_keys, sums, near_slots;
    size_t far_slots, maps, exchange;  // scratch
    uint32_t num_near_slots, num_far_slots;
    size_t shared_bytes;   // of a block
    size_t scratch_bytes;  // of a team
};

V3DG_HD constexpr size_t fragments_bytes(int chunk) {
    return chunk * 33 * sizeof(float2) + 32 * sizeof(float4);
}

struct Cameras {
    FitStep step;  // that these views are part of
    ModelView<float> view[kViewsAtOnce];
    Pinhole<float> camera[kViewsAtOnce];
    const float4* target[kViewsAtOnce];
};

constexpr int kBetweenGroups = 2;

// What the blocks that fit a group share beside arrays.
struct Team {
    unsigned arrived;  // at barriers, ever
    unsigned unit, ticket;
    int cancel[kBetweenGroups + 1];    // noted in turns of steps, and between groups
    uint32_t num_slots[kLargestTeam];  // of each block's part
    double error[kViewsAtOnce][2][2];  // of each block's views, before and after
};

struct Shared {
    Cameras cameras[2];  // of this step and the next
    Team own;            // of a block for itself
    uint32_t warp_total[32];
    FitJob job;
    unsigned arrival;
    int cancel;
};

enum class Pass { measure, draw, train };

// 0, 1, 2, ... to the middle of [0, size), then alternately before and behind it.
__device__ inline int from_middle(int k, int size) { return size / 2 + (k % 2 ? -(k + 1) / 2 : k / 2); }

// On the way back pixels and gaussians meet in chunks of kChunk gaussians of a list.
template <int kThreads, bool kSmall, int kChunk>
struct Fit {
    using Index = std::conditional_t<kSmall, uint16_t, uint32_t>;
    static constexpr int kWarps = kThreads / 32;

    const FitGroupsInput& in;
    const Layout& layout;
    Shared& s;
    Team& all;   // the blocks that fit the group: of a small one those that share its views
    Team& team;  // those that look at the same views: a block of a small group has its own
    const unsigned team_rank, team_size;
    const unsigned view_rank, view_stride;  // the views of a batch that the block looks at
    unsigned char* const scratch;
    unsigned char* const exchange;  // of small groups: gradients by view, where blocks share the views
    unsigned char* const hot;
    // The group.
    const FitJob& job;
    uint32_t n = 0, n_padded = 0;
    int num_sh = 0;
    uint32_t num_values = 0;
    int regions_across = 1;

    __device__ Fit(const FitGroupsInput& input, const Layout& l, Shared& shared, Team* teams,
                   unsigned num_blocks, unsigned char* all_scratch)
        : in(input),
          layout(l),
          s(shared),
          all(teams[s.arrival / num_blocks]),
          team(kSmall ? s.own : all),
          team_rank(kSmall ? 0 : s.arrival % num_blocks),
          team_size(kSmall ? 1 : num_blocks),
          view_rank(kSmall ? s.arrival % num_blocks : 0),
          view_stride(kSmall ? num_blocks : 1),
          scratch(all_scratch + (kSmall ? s.arrival : s.arrival / num_blocks) * l.scratch_bytes),
          exchange(all_scratch + (s.arrival - view_rank) * l.scratch_bytes + l.exchange),
          hot(kSmall ? shared_memory() : scratch),
          job(s.job) {}

    __device__ void take(const FitJob& next) {
        if (threadIdx.x == 0) s.job = next;
        __syncthreads();
        n = static_cast<uint32_t>(job.group.count);
        n_padded = (n + 31) / 32 * 32;
        num_sh = 3 * num_sh_bases(in.rows.sh_degree);
        num_values = n * (11 + num_sh);
        regions_across = kSmall ? 1 : (job.size + kRegion - 1) / kRegion;
    }

    // ---- the team

    __device__ bool leads() const { return threadIdx.x == 0 && team_rank == 0; }
    __device__ bool leads_all() const { return leads() && view_rank == 0; }
    // The team's threads, neighbouring warps in different blocks.
    __device__ uint32_t first() const {
        return (threadIdx.x / 32 * team_size + team_rank) * 32 + threadIdx.x % 32;
    }
    __device__ uint32_t stride() const { return kThreads * team_size; }

    __device__ unsigned num_blocks() const { return team_size * view_stride; }

    // A barrier of those that look at the same views.
    __device__ void sync() const {
        if (team_size > 1)
            meet(-1);
        else
            __syncthreads();
    }

    // A barrier of all blocks that fit the group. They learn alike whether the fit was cancelled: `note` is
    // written before the barrier, and again no sooner than all have come to another.
    __device__ void sync_all(int note) const {
        if (num_blocks() > 1)
            meet(note);
        else
            __syncthreads();
    }
    __device__ void look_for_cancel(int note) const {
        int& cancel = num_blocks() > 1 ? all.cancel[note] : s.cancel;
        cancel = *static_cast<volatile int*>(&in.signals->cancel);
    }

    __device__ void meet(int note) const {
        __syncthreads();
        if (threadIdx.x == 0) {
            __threadfence();
            const unsigned goal = (atomicAdd(&all.arrived, 1u) / num_blocks() + 1) * num_blocks();
            while (*static_cast<volatile unsigned*>(&all.arrived) < goal) {
            }
            __threadfence();
            if (note >= 0) s.cancel = *static_cast<volatile int*>(&all.cancel[note]);
        }
        __syncthreads();
    }

    // ---- arrays

    template <class T>
    __device__ T* hot_at(size_t offset) const {
        return reinterpret_cast<T*>(hot + offset);
    }
    __device__ float* at(const Place& place) const {
        return reinterpret_cast<float*>((place.is_shared ? shared_memory() : scratch) + place.offset);
    }
    // Gaussians have places: those of view b from b * n_padded on. What is blended has ranks: the places of
    // small groups, whose lists go through `order`; positions by depth of large ones, whose records are
    // sorted.
    __device__ Record<float>* records() const { return hot_at<Record<float>>(layout.records); }
    __device__ Record<float>* ranked() const {
        return hot_at<Record<float>>(kSmall ? layout.records : layout.sorted);
    }
    __device__ uint32_t num_places() const { return kViewsAtOnce * n_padded; }
    __device__ uint32_t nothing() const { return num_places(); }  // the rank of a record that draws nothing
    __device__ uint32_t* keys() const { return hot_at<uint32_t>(layout.keys); }
    __device__ Index* order() const { return hot_at<Index>(layout.order); }
    __device__ CellMask* mask(int region) const {
        return hot_at<CellMask>(layout.mask) + (kSmall ? 0 : region * num_places());
    }
    __device__ uint32_t* slot_first(int region) const {
        return hot_at<uint32_t>(layout.slot_first) + (kSmall ? 0 : region * num_places());
    }
    __device__ uint32_t warp() const { return team_rank * kWarps + threadIdx.x / 32; }
    __device__ Index* list(int half) const {
        return hot_at<Index>(layout.lists + (2 * warp() + half) * layout.list_size);
    }
    // What a pixel gives to a gaussian, [gaussian][pixel]: gradient by the exponent, and weight. The spare
    // column keeps lanes that read one pixel each of their own gaussian out of each other's banks.
    __device__ float2* fragments() const {
        return reinterpret_cast<float2*>(shared_memory() + layout.fragments +
                                         threadIdx.x / 32 * fragments_bytes(kChunk));
    }
    __device__ float4* d_pixels() const { return reinterpret_cast<float4*>(fragments() + kChunk * 33); }
    // Of a large group, the records of a chunk, for each half-warp.
    __device__ Record<float>* staged() const {
        return reinterpret_cast<Record<float>*>(shared_memory() + layout.staged) +
               2 * kChunk * (threadIdx.x / 32);
    }
    __device__ int num_regions() const { return regions_across * regions_across; }
    // By the values, from view b of a batch. Blocks that share views write those of one batch while others
    // may still read those of the one before.
    __device__ float* gradient(int turn, int b) const {
        if (view_stride == 1) return at(layout.by_view) + static_cast<size_t>(b) * num_values;
        return reinterpret_cast<float*>(exchange) + static_cast<size_t>(turn * kViewsAtOnce + b) * num_values;
    }

    // ---- parameters: means, quaternions, log scales and logits, a plane each; then SH coefficients,
    // gaussian by gaussian

    __device__ void start() {
        float* value = at(layout.value);
        float *m = at(layout.m), *v = at(layout.v);
        const float inverse = 1 / job.group.radius;
        const GaussianRows<float>& rows = in.rows;
        for (uint32_t i = first(); i < n; i += stride()) {
            const size_t from = job.group.first + i;
            for (int k = 0; k < 3; ++k) {
                value[k * n + i] = (rows.means[3 * from + k] - job.group.center[k]) * inverse;
                value[(7 + k) * n + i] = log_of_scale(rows.scales[3 * from + k] * inverse);
            }
            for (int k = 0; k < 4; ++k) value[(3 + k) * n + i] = rows.quats[4 * from + k];
            value[10 * n + i] = logit_of_opacity(rows.opacities[from]);
        }
        for (uint32_t k = first(); k < num_sh * n; k += stride())
            value[11 * n + k] = rows.sh[num_sh * job.group.first + k];
        for (uint32_t k = first(); k < num_values; k += stride()) m[k] = v[k] = 0;
    }

    // Writes the values back in world units unless one of them is not finite; whether it did.
    __device__ bool write() const {
        const float* value = at(layout.value);
        bool finite = true;
        for (uint32_t k = threadIdx.x; k < num_values; k += kThreads)
            finite = finite && fabsf(value[k]) <= FLT_MAX;
        if (!__syncthreads_and(finite)) return false;
        const GaussianRows<float>& rows = in.rows;
        const FitGroup& group = job.group;
        for (uint32_t i = first(); i < n; i += stride()) {
            const Gaussian3d<float> g = gaussian(i);
            const size_t to = group.first + i;
            const float length = sqrt_of(g.quat[0] * g.quat[0] + g.quat[1] * g.quat[1] +
                                         g.quat[2] * g.quat[2] + g.quat[3] * g.quat[3]);
            for (int k = 0; k < 3; ++k) {
                rows.means[3 * to + k] =
                    static_cast<float>(group.center[k] + static_cast<double>(group.radius) * g.mean[k]);
                rows.scales[3 * to + k] = group.radius * g.scale[k];
            }
            for (int k = 0; k < 4; ++k)
                rows.quats[4 * to + k] = length > 0 ? g.quat[k] / length : static_cast<float>(k == 0);
            rows.opacities[to] = g.opacity;
        }
        for (uint32_t k = first(); k < num_sh * n; k += stride())
            rows.sh[num_sh * group.first + k] = value[11 * n + k];
        return true;
    }

    __device__ Gaussian3d<float> gaussian(uint32_t i) const {
        const float* value = at(layout.value);
        Gaussian3d<float> g;
        for (int k = 0; k < 3; ++k) g.mean[k] = value[k * n + i];
        for (int k = 0; k < 4; ++k) g.quat[k] = value[(3 + k) * n + i];
        for (int k = 0; k < 3; ++k) g.scale[k] = scale_of_log(value[(7 + k) * n + i]);
        g.opacity = opacity_of_logit(value[10 * n + i]);
        return g;
    }

    // ---- views

    __device__ void look(Cameras& cameras, int b, uint64_t picture) const {
        const FitView view = in.views[job.first_view + picture];
        cameras.view[b] = view_of_group(in.config, view);
        cameras.camera[b] = camera_of(view, 1);
        cameras.target[b] = in.targets + job.first_pixel + picture * job.size * job.size;
    }

    // ---- the way forth

    __device__ void project(const Cameras& cameras, int num_views) const {
        for (uint32_t j = first(); j < num_views * n_padded; j += stride()) {
            const uint32_t b = j / n_padded, i = j - b * n_padded;
            uint32_t key = kHiddenKey;
            CellMask reached = 0;
            if (i < n) {
                Record<float> r;
                if (project_one(i, cameras.view[b], cameras.camera[b], r)) {
                    records()[j] = r;
                    key = __float_as_uint(r.depth);
                    if (kSmall) reached = cells_of(r, 0, 0);
                }
            }
            keys()[j] = key;
            if (kSmall) mask(0)[j] = reached;
        }
        if (leads()) {
            Record<float> r{};
            r.log2_opacity = -100;
            ranked()[nothing()] = r;
        }
    }

    __device__ bool project_one(uint32_t i, const ModelView<float>& view, const Pinhole<float>& camera,
                                Record<float>& r) const {
        const Gaussian3d<float> g = gaussian(i);
        Projection<float> p;
        const Ellipse<float> e =
            project_gaussian(g, view, camera, in.config.filter_px2, in.config.compensate, p);
        float half_x, half_y;
        if (!(e.depth >= camera.near_depth) || !extent_of(g.opacity, e, p, half_x, half_y)) return false;
        if (!meets_image(e.u, half_x, camera.width) || !meets_image(e.v, half_y, camera.height)) return false;
        const PixelBox<int> box = pixel_box(e, half_x, half_y, camera, job.size, job.size);
        if (!box.holds_pixels()) return false;
        set_ellipse(e, box, r);
        const float* sh = at(layout.value) + 11 * n + num_sh * i;
        with_degree(in.rows.sh_degree, [&](auto degree) {
            color_of_sh<float>(decltype(degree)::value, g.mean, view, sh, r.color);
        });
        return true;
    }

    // Calls `body` with the degree as a constant, which unrolls its loops.
    template <class Body>
    __device__ static void with_degree(int degree, const Body& body) {
        switch (degree) {
            case 0: return body(std::integral_constant<int, 0>{});
            case 1: return body(std::integral_constant<int, 1>{});
            case 2: return body(std::integral_constant<int, 2>{});
            default: return body(std::integral_constant<int, 3>{});
        }
    }

    // Cells of the region at (left, top) that the record may reach, a bit each, row by row. Rounded to pixel
    // centres, because each cell costs a slot and a place in a list.
    __device__ static CellMask cells_of(const Record<float>& r, int left, int top) {
        const PixelBox<int> box{max(r.x0 - left, 0), min(r.x1 - left, kRegion - 1), max(r.y0 - top, 0),
                                min(r.y1 - top, kRegion - 1)};
        if (!box.holds_pixels()) return 0;
        const EllipseRows<float> ellipse = ellipse_rows(r.l11, r.l12, r.l22, r.log2_opacity);
        const float u = r.u - static_cast<float>(left) - 0.5f, v = r.v - static_cast<float>(top) - 0.5f;
        CellMask reached = 0;
        for (int row = box.y0 / kCell; row <= box.y1 / kCell; ++row) {
            const float low = static_cast<float>(kCell * row) - v;
            float from, to;
            row_extent(ellipse, low, low + static_cast<float>(kCell - 1), from, to);
            const int first = max(box.x0, ceil_to_int(max_of(u + from, -1.0f)));
            const int last = min(box.x1, floor_to_int(min_of(u + to, static_cast<float>(kRegion))));
            if (first > last) continue;
            const uint32_t columns = (2u << last / kCell) - (1u << first / kCell);
            reached |= static_cast<CellMask>(columns) << (kRegionCells * row);
        }
        return reached;
    }

    // Orders the gaussians of each view by depth, ties by place.
    __device__ void sort(int num_views) const {
        if (kSmall || team_size > 1)
            rank_by_counting(num_views);
        else
            for (int b = 0; b < num_views; ++b) sort_bitonic(b);
    }

    __device__ void rank_by_counting(int num_views) const {
        if (kSmall) {
            for (uint32_t j = first(); j < num_views * n_padded; j += stride())
                rank(keys() + j / n_padded * n_padded, j / n_padded * n_padded, j % n_padded);
            return;
        }
        // Keys are read again and again: from shared memory, if they fit where fragments will be.
        auto* copy = reinterpret_cast<uint32_t*>(shared_memory() + layout.fragments);
        const bool fits = n_padded * sizeof(uint32_t) <= kWarps * fragments_bytes(kChunk);
        for (int b = 0; b < num_views; ++b) {
            const uint32_t begin = b * n_padded;
            __syncthreads();
            for (uint32_t i = threadIdx.x; fits && i < n_padded; i += kThreads) copy[i] = keys()[begin + i];
            __syncthreads();
            for (uint32_t i = first(); i < n_padded; i += stride())
                rank(fits ? copy : keys() + begin, begin, i);
        }
    }

    // Puts gaussian `i` of the view whose keys these are into its position.
    __device__ void rank(const uint32_t* view_keys, uint32_t begin, uint32_t i) const {
        const uint4* all = reinterpret_cast<const uint4*>(view_keys);
        const uint32_t key = view_keys[i], warp_first = i - threadIdx.x % 32;
        uint32_t rank = 0;
        // Keys come before at the same depth where their place does: in all runs of 32 before this
        // warp's, in none behind.
        const auto count = [&](uint32_t from, uint32_t to, const auto& before) {
            for (uint32_t run = from; run < to; run += 32) {
                uint4 other[8];
#pragma unroll
                for (int q = 0; q < 8; ++q) other[q] = all[run / 4 + q];
#pragma unroll
                for (int q = 0; q < 8; ++q) {
                    const uint32_t k = run + 4 * q;
                    rank += before(other[q].x, k) + before(other[q].y, k + 1);
                    rank += before(other[q].z, k + 2) + before(other[q].w, k + 3);
                }
            }
        };
        count(0, warp_first, [&](uint32_t other, uint32_t) { return other <= key; });
        count(warp_first, warp_first + 32, [&](uint32_t other, uint32_t k) { return other < key + (k < i); });
        count(warp_first + 32, n_padded, [&](uint32_t other, uint32_t) { return other < key; });
        order()[begin + rank] = static_cast<Index>(begin + i);
    }

    __device__ void sort_bitonic(int b) const {
        auto* sorted = reinterpret_cast<unsigned long long*>(at(layout.sort_keys));
        uint32_t size = 32;
        while (size < n) size *= 2;
        const uint32_t begin = b * n_padded;
        for (uint32_t i = threadIdx.x; i < size; i += kThreads)
            sorted[i] =
                i < n ? static_cast<unsigned long long>(keys()[begin + i]) << 32 | (begin + i) : ~0ull;
        __syncthreads();
        for (uint32_t run = 2; run <= size; run *= 2)
            for (uint32_t stride = run / 2; stride > 0; stride /= 2) {
                for (uint32_t t = threadIdx.x; t < size / 2; t += kThreads) {
                    const uint32_t low = 2 * t - (t & (stride - 1)), high = low + stride;
                    const unsigned long long x = sorted[low], y = sorted[high];
                    if ((x > y) == ((low & run) == 0)) {
                        sorted[low] = y;
                        sorted[high] = x;
                    }
                }
                __syncthreads();
            }
        for (uint32_t i = threadIdx.x; i < n_padded; i += kThreads)
            order()[begin + i] = i < n ? static_cast<Index>(sorted[i]) : static_cast<Index>(begin + i);
        __syncthreads();
    }

    // Large groups: sorts the records, and finds the cells of each.
    __device__ void arrange(int num_views) const {
        for (uint32_t r = first(); r < num_views * n_padded; r += stride()) {
            const uint32_t j = order()[r];
            const bool is_hidden = keys()[j] == kHiddenKey;
            Record<float> record{};
            if (!is_hidden) ranked()[r] = record = records()[j];
            for (int region = 0; region < num_regions(); ++region)
                mask(region)[r] = is_hidden ? 0
                                            : cells_of(record, region % regions_across * kRegion,
                                                       region / regions_across * kRegion);
        }
    }

    // Gives each record a slot for each cell that it reaches, region by region, and counts them.
    __device__ uint32_t assign_slots(int num_views) const {
        const uint32_t used = num_views * n_padded, count = num_regions() * used;
        const auto mask_at = [&](uint32_t t) { return kSmall ? mask(0)[t] : mask(t / used)[t % used]; };
        const uint32_t each = (count + stride() - 1) / stride();
        const uint32_t begin = min(count, (team_rank * kThreads + threadIdx.x) * each);
        const uint32_t end = min(count, begin + each);
        uint32_t own = 0;
        for (uint32_t t = begin; t < end; ++t) own += __popcll(mask_at(t));
        const uint32_t upto = warp_prefix(own);
        if (threadIdx.x % 32 == 31) s.warp_total[threadIdx.x / 32] = upto;
        __syncthreads();
        uint32_t before = upto - own, total = 0;
        for (uint32_t w = 0; w < kWarps; ++w) {
            if (w < threadIdx.x / 32) before += s.warp_total[w];
            total += s.warp_total[w];
        }
        if (team_size > 1) {
            if (threadIdx.x == 0) team.num_slots[team_rank] = total;
            sync();
            total = 0;
            for (unsigned block = 0; block < team_size; ++block) {
                if (block < team_rank) before += team.num_slots[block];
                total += team.num_slots[block];
            }
        }
        for (uint32_t t = begin; t < end; ++t) {
            slot_first(kSmall ? 0 : t / used)[kSmall ? t : t % used] = before;
            before += __popcll(mask_at(t));
        }
        return total;
    }

    // ---- blending

    // A lane's pixel in its half-warp's cell.
    struct Pixel {
        int x, y;
        float center_x, center_y;
        bool inside;
    };

    __device__ Pixel pixel_at(int cell_x, int cell_y) const {
        const int lane = threadIdx.x % kCellPixels;
        const int x = cell_x * kCell + lane % kCell, y = cell_y * kCell + lane / kCell;
        return {x, y, static_cast<float>(x) + 0.5f, static_cast<float>(y) + 0.5f,
                x < job.size && y < job.size};
    }

    struct alignas(kAtOnce * sizeof(Index)) Entries {
        Index record[kAtOnce];
    };

    // What reaches each half-warp's cell, nearest first, filled up with nothing to the same length for both.
    struct List {
        const Index* entry;
        uint32_t length, filled;
    };

    // Of view b; `cell` is the left one's bit.
    __device__ List make_lists(int b, int region, int cell) const {
        constexpr int kLoads = 4;
        const uint32_t lane = threadIdx.x % 32, before = (1u << lane) - 1;
        const CellMask* masks = mask(region);
        uint32_t left = 0, right = 0;
        for (uint32_t first = 0; first < n_padded; first += 32 * kLoads) {
            Index j[kLoads];
            uint32_t reached[kLoads];
#pragma unroll
            for (int q = 0; q < kLoads; ++q) {
                const uint32_t i = first + 32 * q + lane;
                reached[q] = 0;
                if (i >= n_padded) continue;
                j[q] = static_cast<Index>(b * n_padded + i);
                if (kSmall) j[q] = order()[j[q]];
                reached[q] = static_cast<uint32_t>(masks[j[q]] >> cell) & 3;
            }
#pragma unroll
            for (int q = 0; q < kLoads; ++q) {
                const uint32_t in_left = __ballot_sync(kAllLanes, reached[q] & 1);
                const uint32_t in_right = __ballot_sync(kAllLanes, reached[q] & 2);
                if (reached[q] & 1) list(0)[left + __popc(in_left & before)] = j[q];
                if (reached[q] & 2) list(1)[right + __popc(in_right & before)] = j[q];
                left += __popc(in_left);
                right += __popc(in_right);
            }
        }
        const int half = lane / kCellPixels;
        const uint32_t length = half == 0 ? left : right;
        const uint32_t filled = (max(left, right) + kAtOnce - 1) / kAtOnce * kAtOnce;
        Index* const own = list(half);
        for (uint32_t i = length + lane % kCellPixels; i < filled; i += kCellPixels)
            own[i] = static_cast<Index>(nothing());
        __syncwarp();
        return {own, length, filled};
    }

    // Large groups: brings part of both half-warps' lists into shared memory.
    __device__ void stage(uint32_t begin, uint32_t end) const {
        if (kSmall) return;
        __syncwarp();
        for (uint32_t i = threadIdx.x % 32; i < 2 * kChunk; i += 32) {
            const uint32_t entry = begin + i % kChunk;
            if (entry >= end) continue;
            const auto* from = reinterpret_cast<const float4*>(ranked() + list(i / kChunk)[entry]);
            auto* to = reinterpret_cast<float4*>(staged() + i);
            for (int k = 0; k < kRecordVectors; ++k) to[k] = from[k];
        }
        __syncwarp();
    }

    // kAtOnce records of a half-warp's list, from entry i on; `begin` is that of the chunk.
    struct Records {
        const Record<float>* record[kAtOnce];
    };
    __device__ Records records_at(const List& list, uint32_t i, uint32_t begin) const {
        Records out;
        if (kSmall) {
            const Entries entries = *reinterpret_cast<const Entries*>(list.entry + i);
#pragma unroll
            for (int q = 0; q < kAtOnce; ++q) out.record[q] = ranked() + entries.record[q];
        } else {
            const Record<float>* first = staged() + threadIdx.x % 32 / kCellPixels * kChunk + (i - begin);
#pragma unroll
            for (int q = 0; q < kAtOnce; ++q) out.record[q] = first + q;
        }
        return out;
    }

    // What kAtOnce gaussians give to a pixel, one behind the other.
    struct Blended {
        float alpha[kAtOnce], before[kAtOnce], weight[kAtOnce];
        float3 color[kAtOnce];
    };
    __device__ Blended blend(const Pixel& p, const Records& records, float& transmittance) const {
        Blended out;
#pragma unroll
        for (int q = 0; q < kAtOnce; ++q) {
            const Record<float> r = load_record(records.record[q]);
            out.alpha[q] =
                alpha_of(falloff_at(p.center_x, p.center_y, r.u, r.v, r.l11, r.l12, r.l22, r.log2_opacity));
            out.color[q] = make_float3(r.color[0], r.color[1], r.color[2]);
        }
        blend_weights(out.alpha, transmittance, out.before, out.weight);
        return out;
    }

    // Where a pass reads and writes.
    struct Targets {
        float* slots;          // train
        uint32_t slot_base;    // of the first of them
        const float* d_dssim;  // train; may be null
        float* picture;        // draw
        float2* errors;        // measure
    };

    // A warp takes two cells side by side in view b. `unit` numbers the pair.
    template <Pass kPass>
    __device__ void blend_cells(const Cameras& cameras, int b, int pair_x, int cell_y, uint32_t unit,
                                const Targets& targets) const {
        const uint32_t lane = threadIdx.x % 32;
        const Pixel p = pixel_at(2 * pair_x + lane / kCellPixels, cell_y);
        const int region = cell_y / kRegionCells * regions_across + 2 * pair_x / kRegionCells;
        const int left_cell = cell_y % kRegionCells * kRegionCells + 2 * pair_x % kRegionCells;
        const int cell = left_cell + lane / kCellPixels;
        const size_t num_pixels = static_cast<size_t>(job.size) * job.size;
        const size_t at = static_cast<size_t>(p.y) * job.size + p.x;
        float4 target = make_float4(0, 0, 0, 0);
        if (kPass != Pass::draw && p.inside) target = cameras.target[b][at];
        const List list = make_lists(b, region, left_cell);
        if (kPass == Pass::train && list.filled == 0) return;

        float color[3] = {0, 0, 0}, transmittance = p.inside ? 1 : -1;
        for (uint32_t begin = 0; begin < list.filled && __any_sync(kAllLanes, transmittance > 0);
             begin += kChunk) {
            stage(begin, list.filled);
            const uint32_t end = min(list.filled, begin + kChunk);
            for (uint32_t i = begin; i < end; i += kAtOnce) {
                const Blended blended = blend(p, records_at(list, i, begin), transmittance);
#pragma unroll
                for (int q = 0; q < kAtOnce; ++q) {
                    color[0] += blended.weight[q] * blended.color[q].x;
                    color[1] += blended.weight[q] * blended.color[q].y;
                    color[2] += blended.weight[q] * blended.color[q].z;
                }
            }
        }
        if (kPass == Pass::draw) {
            if (p.inside)
                for (int c = 0; c < 3; ++c) targets.picture[(3 * b + c) * num_pixels + at] = color[c];
            return;
        }
        const float difference[4] = {color[0] - target.x, color[1] - target.y, color[2] - target.z,
                                     1 - fabsf(transmittance) - target.w};
        if (kPass == Pass::measure) {
            float in_color = 0, in_alpha = 0;
            if (p.inside) {
                in_color = fabsf(difference[0]) + fabsf(difference[1]) + fabsf(difference[2]);
                in_alpha = fabsf(difference[3]);
            }
            in_color = warp_sum(in_color);
            in_alpha = warp_sum(in_alpha);
            if (lane == 0) targets.errors[unit] = make_float2(in_color, in_alpha);
            return;
        }

        float d[4] = {0, 0, 0, 0};
        if (p.inside) {
            const LossWeights& loss = in.config.loss;
            const float pixels = static_cast<float>(num_pixels);
            const float d_color = loss.l1 / (3 * pixels), d_alpha = loss.alpha / pixels;
            for (int c = 0; c < 3; ++c) d[c] = l1_vjp(difference[c], d_color);
            d[3] = l1_vjp(difference[3], d_alpha);
            if (targets.d_dssim != nullptr)
                for (int c = 0; c < 3; ++c) d[c] += targets.d_dssim[(3 * b + c) * num_pixels + at];
        }
        d_pixels()[lane] = make_float4(d[0], d[1], d[2], 0);

        // The same walk again, on the same numbers, now that it is known what all gaussians give together.
        const auto slot_of = [&](uint32_t j) {
            const uint32_t slot =
                slot_first(region)[j] + __popcll(mask(region)[j] & ((CellMask(1) << cell) - 1));
            return targets.slots + kSums * static_cast<size_t>(slot - targets.slot_base);
        };
        float2* const mine = fragments() + lane;  // this pixel's
        float behind =
            d[0] * color[0] + d[1] * color[1] + d[2] * color[2] + d[3] * (1 - fabsf(transmittance));
        transmittance = p.inside ? 1 : -1;
        uint32_t begin = 0;
        for (; begin < list.filled && __any_sync(kAllLanes, transmittance > 0); begin += kChunk) {
            stage(begin, list.filled);
            const uint32_t end = min(list.filled, begin + kChunk);
            for (uint32_t i = begin; i < end; i += kAtOnce) {
                const Blended blended = blend(p, records_at(list, i, begin), transmittance);
#pragma unroll
                for (int q = 0; q < kAtOnce; ++q) {
                    const float3& rgb = blended.color[q];
                    const float by_weight = d[0] * rgb.x + d[1] * rgb.y + d[2] * rgb.z + d[3];
                    behind -= blended.weight[q] * by_weight;
                    mine[(i - begin + q) * 33] =
                        make_float2(exponent_vjp(blended.alpha[q], blended.before[q], blended.weight[q],
                                                 by_weight, behind),
                                    blended.weight[q]);
                }
            }
            __syncwarp();
            for (uint32_t i = lane % kCellPixels; i < end - begin; i += kCellPixels) {
                if (begin + i >= list.length) continue;
                const uint32_t j = list.entry[begin + i];
                add_up(p, i, kSmall ? ranked()[j] : staged()[lane / kCellPixels * kChunk + i], slot_of(j));
            }
            __syncwarp();
        }
        // Nothing was left to blend for the rest.
        for (uint32_t i = begin + lane % kCellPixels; i < list.length; i += kCellPixels) {
            float* slot = slot_of(list.entry[i]);
            for (int k = 0; k < kSums; ++k) slot[k] = 0;
        }
    }

    // Sums over the half-warp's cell, for record r, which is gaussian `i` of the chunk.
    __device__ void add_up(const Pixel& p, uint32_t i, const Record<float>& record, float* slot) const {
        const Record<float> r = load_record(&record);
        const uint32_t half = threadIdx.x % 32 / kCellPixels;
        const float2* shares = fragments() + 33 * i + half * kCellPixels;
        const float4* d_colors = d_pixels() + half * kCellPixels;
        const float left = static_cast<float>(p.x / kCell * kCell) + 0.5f,
                    top = static_cast<float>(p.y / kCell * kCell) + 0.5f;
        FalloffSums<float> sums{};
        float color[3] = {0, 0, 0};
#pragma unroll
        for (int y = 0; y < kCell; ++y) {
            RowSums<float> row{};
            Falloff<float> f;
#pragma unroll
            for (int x = 0; x < kCell; ++x) {
                const float2 share = shares[y * kCell + x];
                const float4 d_color = d_colors[y * kCell + x];
                f = falloff_at(left + x, top + y, r.u, r.v, r.l11, r.l12, r.l22, 0.0f);
                row.add(f, share.x);
                color[0] += share.y * d_color.x;
                color[1] += share.y * d_color.y;
                color[2] += share.y * d_color.z;
            }
            sums += row.of_falloff(f);
        }
        slot[0] = sums.exponent;
        slot[1] = sums.t1;
        slot[2] = sums.t2;
        slot[3] = sums.t1_dx;
        slot[4] = sums.t1_dy;
        slot[5] = sums.t2_dy;
        for (int c = 0; c < 3; ++c) slot[6 + c] = color[c];
    }

    __device__ int cell_rows() const { return (job.size + kCell - 1) / kCell; }
    __device__ int cell_pairs() const { return (job.size + 2 * kCell - 1) / (2 * kCell); }

    // Warps take pairs of cells from a queue, those in the middle first, which have most to blend.
    template <Pass kPass>
    __device__ void blend_regions(const Cameras& cameras, int num_views, int first_region, int last_region,
                                  const Targets& targets) const {
        const int rows = cell_rows(), pairs = cell_pairs();
        for (;;) {
            uint32_t unit = 0;
            if (threadIdx.x % 32 == 0) unit = atomicAdd(&team.unit, 1u);
            unit = __shfl_sync(kAllLanes, unit, 0);
            if (unit >= static_cast<uint32_t>(num_views * rows * pairs)) return;
            const int b = unit % num_views, pair_x = unit / num_views % pairs;
            const int cell_y = from_middle(unit / num_views / pairs, rows);
            const int region = cell_y / kRegionCells * regions_across + 2 * pair_x / kRegionCells;
            if (!kSmall && (region < first_region || region >= last_region)) continue;
            blend_cells<kPass>(cameras, b, pair_x, cell_y, unit, targets);
            __syncwarp();
        }
    }

    // ---- D-SSIM

    // Writes the gradient of D-SSIM by the pictures, three planes each.
    __device__ void dssim_backward(const Cameras& cameras, int num_views, const float* pictures,
                                   float* d_pictures, float* all_maps) const {
        const int size = job.size;
        const uint32_t num_pixels = size * size, count = 3 * num_views * num_pixels;
        const float scale = -in.config.loss.dssim / (3 * static_cast<float>(num_pixels));
        // The window's sums of `kMaps` maps along rows (step 1) or columns.
        const auto blur = [&](const float* maps, uint32_t i, int place, int step, auto& sums) {
#pragma unroll
            for (int k = -kSsimRadius; k <= kSsimRadius; ++k)
                if (place + k >= 0 && place + k < size)
                    for (int m = 0; m < static_cast<int>(sizeof(sums) / sizeof(float)); ++m)
                        sums[m] += ssim_weight(k) * maps[m * num_pixels + i + k * step];
        };
        const auto for_each_pixel = [&](const auto& body) {
            for (uint32_t t = first(); t < count; t += stride()) {
                const uint32_t plane = t / num_pixels, i = t - plane * num_pixels;
                body(plane, i, all_maps + static_cast<size_t>(8 * plane) * num_pixels);
            }
            sync();
        };
        const auto target_of = [&](uint32_t plane, uint32_t i) {
            return (&cameras.target[plane / 3]->x)[4 * static_cast<size_t>(i) + plane % 3];
        };
        for_each_pixel([&](uint32_t plane, uint32_t i, float* maps) {
            const float* picture = pictures + static_cast<size_t>(plane) * num_pixels;
            const int column = i % size;
            SsimSums sums{};
#pragma unroll
            for (int k = -kSsimRadius; k <= kSsimRadius; ++k) {
                if (column + k < 0 || column + k >= size) continue;
                const float w = ssim_weight(k), x = picture[i + k], y = target_of(plane, i + k);
                sums.x += w * x;
                sums.y += w * y;
                sums.xx += w * x * x;
                sums.yy += w * y * y;
                sums.xy += w * x * y;
            }
            maps[i] = sums.x;
            maps[num_pixels + i] = sums.y;
            maps[2 * num_pixels + i] = sums.xx;
            maps[3 * num_pixels + i] = sums.yy;
            maps[4 * num_pixels + i] = sums.xy;
        });
        for_each_pixel([&](uint32_t, uint32_t i, float* maps) {
            float sums[5] = {0, 0, 0, 0, 0};
            blur(maps, i, i / size, size, sums);
            const Ssim ssim = ssim_of({sums[0], sums[1], sums[2], sums[3], sums[4]});
            maps[5 * num_pixels + i] = scale * ssim.d_x;
            maps[6 * num_pixels + i] = scale * ssim.d_xx;
            maps[7 * num_pixels + i] = scale * ssim.d_xy;
        });
        // Back through the window, which is its own transpose.
        for_each_pixel([&](uint32_t, uint32_t i, float* maps) {
            float sums[3] = {0, 0, 0};
            blur(maps + 5 * num_pixels, i, i % size, 1, sums);
            for (int m = 0; m < 3; ++m) maps[m * num_pixels + i] = sums[m];
        });
        for_each_pixel([&](uint32_t plane, uint32_t i, float* maps) {
            float sums[3] = {0, 0, 0};
            blur(maps, i, i / size, size, sums);
            const size_t at = static_cast<size_t>(plane) * num_pixels + i;
            d_pictures[at] = sums[0] + 2 * pictures[at] * sums[1] + target_of(plane, i) * sums[2];
        });
    }

    // ---- the way back

    // Adds up each record's slots in these regions, onto what earlier ones gave.
    __device__ void sum_slots(int num_views, const float* slots, uint32_t slot_base, int first_region,
                              int last_region) const {
        constexpr int kLoads = 8;
        float* sums = at(layout.sums);
        for (uint32_t q = first(); q < num_views * n_padded * kSums; q += stride()) {
            const uint32_t j = q / kSums, k = q - j * kSums;
            float sum = first_region == 0 ? 0 : sums[kSumStride * j + k];
            for (int region = first_region; region < last_region; ++region) {
                const uint32_t count = __popcll(mask(region)[j]);
                const float* slot =
                    slots + kSums * static_cast<size_t>(slot_first(region)[j] - slot_base) + k;
                for (uint32_t t = 0; t < count; t += kLoads) {
                    float x[kLoads];
#pragma unroll
                    for (int l = 0; l < kLoads; ++l) x[l] = t + l < count ? slot[kSums * (t + l)] : 0;
#pragma unroll
                    for (int l = 0; l < kLoads; ++l) sum += x[l];
                }
            }
            sums[kSumStride * j + k] = sum;
        }
    }

    // From the sums of records to gradients of the parameters, for each view.
    __device__ void project_backward(const Cameras& cameras, int num_views, int turn) const {
        const float* sums = at(layout.sums);
        const float* value = at(layout.value);
        for (uint32_t j = first(); j < num_views * n_padded; j += stride()) {
            const uint32_t b = j / n_padded, place = kSmall ? j : order()[j], i = place - b * n_padded;
            if (i >= n) continue;
            float* out = gradient(turn, view_rank + b);
            float* d_sh = out + 11 * n + num_sh * i;
            if (keys()[place] == kHiddenKey) {
                for (int k = 0; k < 11; ++k) out[k * n + i] = 0;
                for (int k = 0; k < num_sh; ++k) d_sh[k] = 0;
                continue;
            }
            const float* d = sums + kSumStride * j;
            const ModelView<float>& view = cameras.view[b];
            const Pinhole<float>& camera = cameras.camera[b];
            const float filter_px2 = in.config.filter_px2;
            const bool compensate = in.config.compensate;
            const Gaussian3d<float> g = gaussian(i);
            Projection<float> p;
            const Ellipse<float> e = project_gaussian(g, view, camera, filter_px2, compensate, p);
            const Ellipse<float> d_ellipse =
                falloff_vjp(e.l11, e.l12, e.l22, FalloffSums<float>{d[0], d[1], d[2], d[3], d[4], d[5]});
            Gaussian3d<float> d_g =
                project_gaussian_vjp(g, view, camera, filter_px2, compensate, p, e, d_ellipse);
            const float* sh = value + 11 * n + num_sh * i;
            with_degree(in.rows.sh_degree, [&](auto degree) {
                float color[3];
                constexpr int kDegree = decltype(degree)::value;
                color_of_sh<float>(kDegree, g.mean, view, sh, color);
                color_of_sh_vjp<float>(kDegree, g.mean, view, sh, color, d + 6, d_g.mean, d_sh);
            });
            for (int k = 0; k < 3; ++k) out[k * n + i] = d_g.mean[k];
            for (int k = 0; k < 4; ++k) out[(3 + k) * n + i] = d_g.quat[k];
            for (int k = 0; k < 3; ++k) out[(7 + k) * n + i] = d_g.scale[k] * g.scale[k];
            out[10 * n + i] = d_g.opacity * g.opacity * (1 - g.opacity);
        }
    }

    // Adds the views' gradients to those of the step so far; Adam follows the last.
    __device__ void move(const FitStep& step, int num_views, int turn, bool is_first, bool is_last) const {
        float *value = at(layout.value), *m = at(layout.m), *v = at(layout.v), *sum = at(layout.sum);
        const float position = position_step(in.config, job.group, step);
#pragma unroll 2
        for (uint32_t k = first(); k < num_values; k += stride()) {
            float sum_of_views = is_first ? 0 : sum[k];
            for (int b = 0; b < num_views; ++b) sum_of_views += gradient(turn, b)[k];
            if (!is_last) {
                sum[k] = sum_of_views;
                continue;
            }
            float size = step.sh0;
            if (k < 3 * n)
                size = position;
            else if (k < 7 * n)
                size = step.quat;
            else if (k < 10 * n)
                size = step.log_scale;
            else if (k < 11 * n)
                size = step.logit;
            else if (num_sh > 3 && (k - 11 * n) % num_sh >= 3)
                size = step.sh_rest;
            const float moved =
                adam_step(value[k], sum_of_views, m[k], v[k], size, step.correction1, step.correction2);
            value[k] = k < 3 * n ? held_in_box(moved) : moved;
        }
    }

    // ---- a batch of views, and all of them

    // Adds the |difference| of colour and alpha, summed over pixels, in every thread.
    __device__ void measure(const Cameras& cameras, int num_views, double error[2]) const {
        Targets targets{};
        targets.errors = hot_at<float2>(layout.errors);
        blend_regions<Pass::measure>(cameras, num_views, 0, num_regions(), targets);
        sync();
        for (int unit = 0; unit < num_views * cell_rows() * cell_pairs(); ++unit) {
            error[0] += static_cast<double>(targets.errors[unit].x);
            error[1] += static_cast<double>(targets.errors[unit].y);
        }
        if (leads()) team.unit = 0;
    }

    // Leaves the gradients of the parameters, for each view.
    __device__ void differentiate(const Cameras& cameras, int num_views, int turn) const {
        Targets targets{};
        if (in.config.loss.dssim > 0) {
            const size_t planes = static_cast<size_t>(3 * kViewsAtOnce) * job.size * job.size;
            float* maps = reinterpret_cast<float*>(scratch + layout.maps);
            targets.picture = maps;
            blend_regions<Pass::draw>(cameras, num_views, 0, num_regions(), targets);
            sync();
            if (leads()) team.unit = 0;
            dssim_backward(cameras, num_views, maps, maps + planes, maps + 2 * planes);
            targets.d_dssim = maps + planes;
        }
        const uint32_t num_slots = assign_slots(num_views);
        sync();
        const bool is_near = num_slots <= layout.num_near_slots;
        targets.slots =
            is_near ? at(layout.near_slots) : reinterpret_cast<float*>(scratch + layout.far_slots);
        const uint32_t capacity = is_near ? num_slots : layout.num_far_slots;
        // All regions at once, unless their slots are more than there is room for.
        const auto slots_before = [&](int region) {
            return region < num_regions() ? slot_first(region)[0] : num_slots;
        };
        for (int region = 0; region < num_regions();) {
            int last = region + 1;
            targets.slot_base = slots_before(region);
            while (last < num_regions() && slots_before(last + 1) - targets.slot_base <= capacity) ++last;
            blend_regions<Pass::train>(cameras, num_views, region, last, targets);
            sync();
            sum_slots(num_views, targets.slots, targets.slot_base, region, last);
            if (leads()) team.unit = 0;
            sync();
            region = last;
        }
        project_backward(cameras, num_views, turn);
    }

    // The views held out, those of all steps, and those held out again, in batches of at most kViewsAtOnce.
    __device__ void fit() {
        const FitConfig& config = in.config;
        const int views_per_step = config.views_per_step;
        const int64_t num_visits = static_cast<int64_t>(config.steps) * views_per_step;
        // Visits of steps count from 0; those of the views held out lie before and after.
        const auto views_at = [&](int64_t visit) {
            const int64_t left = visit < 0            ? -visit
                                 : visit < num_visits ? views_per_step - visit % views_per_step
                                                      : num_visits + kHeldOutViews - visit;
            return static_cast<int>(min(static_cast<int64_t>(kViewsAtOnce), left));
        };
        // Of the views of a batch, this block's.
        const auto own_of = [&](int num_views) {
            return view_stride == 1 ? num_views : static_cast<int>(view_rank) < num_views ? 1 : 0;
        };
        const auto look_from = [&](Cameras& cameras, int64_t first) {
            const int b = static_cast<int>(threadIdx.x) - (kThreads - 32);  // the warp with least to do
            if (b == kViewsAtOnce && first >= 0 && first < num_visits)
                cameras.step = fit_step(config, static_cast<int>(first / views_per_step));
            if (b < 0 || b >= own_of(views_at(first))) return;
            const int64_t visit = first + view_rank + b;
            uint64_t picture;
            if (visit >= 0 && visit < num_visits) {
                picture = visited_view(config, in.stride, visit);
            } else {
                picture =
                    num_fitted_pictures(config) + (visit < 0 ? visit + kHeldOutViews : visit - num_visits);
            }
            look(cameras, b, picture);
        };
        double error[2][2] = {{0, 0}, {0, 0}};  // before and after
        start();
        look_from(s.cameras[0], -kHeldOutViews);
        if (leads()) team.unit = 0;
        sync();
        int turn = 0;
        for (int64_t visit = -kHeldOutViews; visit < num_visits + kHeldOutViews; turn ^= 1) {
            const int num_views = views_at(visit);
            const int num_own = own_of(num_views);
            const Cameras& cameras = s.cameras[turn];
            project(cameras, num_own);
            sync();
            sort(num_own);
            sync();
            if (!kSmall) {
                arrange(num_own);
                sync();
            }
            look_from(s.cameras[turn ^ 1], visit + num_views);
            if (visit < 0 || visit >= num_visits) {
                measure(cameras, num_own, error[visit >= 0]);
            } else {
                const int index = static_cast<int>(visit / views_per_step),
                          within = static_cast<int>(visit % views_per_step);
                if (leads_all() && within == 0 && index % kStepsPerPoll == 0) look_for_cancel(turn);
                differentiate(cameras, num_own, turn);
                sync_all(turn);
                if (s.cancel) return;
                move(cameras.step, num_views, turn, within == 0, within + num_views == views_per_step);
            }
            sync();
            visit += num_views;
        }
        if (view_stride > 1) {
            if (threadIdx.x == 0)
                for (int e = 0; e < 4; ++e) all.error[view_rank][e / 2][e % 2] = error[e / 2][e % 2];
            meet(-1);
            for (int e = 0; e < 4; ++e) {
                error[e / 2][e % 2] = 0;
                for (unsigned rank = 0; rank < view_stride; ++rank)
                    error[e / 2][e % 2] += all.error[rank][e / 2][e % 2];
            }
            if (view_rank > 0) return;
        }
        const double num_pixels = static_cast<double>(job.size) * job.size * kHeldOutViews;
        for (auto& e : error) {
            e[0] /= 3 * num_pixels;
            e[1] /= num_pixels;
        }
        const bool better = num_visits > 0 &&
                            residual_loss(config.loss, error[1]) <= residual_loss(config.loss, error[0]) &&
                            write();
        if (!leads()) return;
        for (int k = 0; k < 2; ++k) in.error[2 * job.error + k] = static_cast<float>(error[better][k]);
    }
};

// Counters of the queue, on the device.
struct Queue {
    unsigned arrived, next;
    unsigned long long groups_done, loss_sum;
};

template <int kThreads, int kBlocks, bool kSmall, int kChunk>
__global__ void __launch_bounds__(kThreads, kBlocks)
    fit_groups_kernel(const FitGroupsInput in, const Layout layout, unsigned char* scratch,
                      unsigned num_blocks, Team* teams, Queue* queue) {
    __shared__ Shared s;
    // Blocks are put together as they arrive, so that they only wait for blocks that run or will.
    if (threadIdx.x == 0) s.arrival = atomicAdd(&queue->arrived, 1u);
    __syncthreads();
    Fit<kThreads, kSmall, kChunk> fit(in, layout, s, teams, num_blocks, scratch);
    for (;;) {
        if (fit.leads_all()) {
            fit.all.ticket = atomicAdd(&queue->next, 1u);
            fit.look_for_cancel(kBetweenGroups);
        }
        fit.sync_all(kBetweenGroups);
        const unsigned ticket = *static_cast<volatile unsigned*>(&fit.all.ticket);
        if (ticket >= in.jobs.size || s.cancel) return;
        fit.take(in.jobs.data[ticket]);
        fit.fit();
        if (s.cancel) return;
        fit.sync();
        if (!fit.leads_all()) continue;
        const float* error = in.error + 2 * fit.job.error;
        const double loss[2] = {error[0], error[1]};
        const auto share =
            static_cast<unsigned long long>(residual_loss(in.config.loss, loss) * 4294967296.0);
        volatile FitSignals* signals = in.signals;
        signals->loss_sum = atomicAdd(&queue->loss_sum, share) + share;
        signals->groups_done = atomicAdd(&queue->groups_done, 1ull) + 1;
    }
}

// Deals out memory: shared while it lasts, where that is asked for.
struct Arena {
    size_t shared_limit, shared = 0, scratch = 0;

    static size_t rounded(size_t bytes) { return (bytes + 15) / 16 * 16; }
    size_t in_shared(size_t bytes) {
        shared += rounded(bytes);
        return shared - rounded(bytes);
    }
    size_t in_scratch(size_t bytes) {
        scratch += rounded(bytes);
        return scratch - rounded(bytes);
    }
};

// For groups of at most `most` gaussians and pictures of at most `largest` pixels a side.
template <int kThreads, bool kSmall, int kChunk>
Layout layout_of(const FitGroupsInput& in, uint32_t most, int largest, size_t num_blocks,
                 size_t shared_limit) {
    Layout l{};
    Arena arena{shared_limit};
    const auto hot = [&](size_t bytes) { return kSmall ? arena.in_shared(bytes) : arena.in_scratch(bytes); };
    const auto anywhere = [&](size_t bytes) {
        const bool fits = kSmall && arena.shared + Arena::rounded(bytes) <= shared_limit;
        return Place{fits ? arena.in_shared(bytes) : arena.in_scratch(bytes), fits};
    };
    const size_t warps = kThreads / 32 * (kSmall ? 1 : num_blocks),
                 fragments = kThreads / 32 * fragments_bytes(kChunk);
    const size_t padded = (most + 31) / 32 * 32, places = kViewsAtOnce * padded;
    const size_t values = most * (11 + 3 * static_cast<size_t>(num_sh_bases(in.rows.sh_degree)));
    const size_t regions_across = (largest + kRegion - 1) / kRegion,
                 regions = regions_across * regions_across;
    const size_t cells = static_cast<size_t>((largest + kCell - 1) / kCell) * ((largest + kCell - 1) / kCell);
    const size_t index = sizeof(typename Fit<kThreads, kSmall, kChunk>::Index);
    l.records = hot((places + 1) * sizeof(Record<float>));
    if (!kSmall) l.sorted = hot((places + 1) * sizeof(Record<float>));
    l.keys = hot(places * sizeof(uint32_t));
    l.mask = hot(regions * places * sizeof(CellMask));
    l.slot_first = hot(regions * places * sizeof(uint32_t));
    l.order = hot(places * index);
    l.list_size = Arena::rounded((padded + kAtOnce) * index);
    l.lists = hot(2 * warps * l.list_size);
    l.errors = hot(kViewsAtOnce * (cells + largest) * sizeof(float2));
    l.fragments = arena.in_shared(fragments);
    if (!kSmall) l.staged = arena.in_shared(kThreads / 32 * 2 * kChunk * sizeof(Record<float>));
    // Fragments are done with when gradients come, and not begun when keys are sorted.
    const auto over_fragments = [&](size_t bytes) {
        return num_blocks == 1 && bytes <= fragments ? Place{l.fragments, true} : anywhere(bytes);
    };
    if (kSmall && num_blocks > 1)
        l.exchange = arena.in_scratch(2 * kViewsAtOnce * values * sizeof(float));
    else
        l.by_view = over_fragments(kViewsAtOnce * values * sizeof(float));
    if (!kSmall) {
        size_t size = 32;
        while (size < most) size *= 2;
        l.sort_keys = over_fragments(size * sizeof(unsigned long long));
    }
    // Sums take the place of the records that were projected.
    static_assert(kSumStride * sizeof(float) == sizeof(Record<float>), "");
    l.sums = {l.records, kSmall};
    l.value = anywhere(values * sizeof(float));
    l.m = anywhere(values * sizeof(float));
    l.v = anywhere(values * sizeof(float));
    l.sum = {arena.in_scratch(values * sizeof(float)), false};
    // At least what one region can take.
    l.num_far_slots = static_cast<uint32_t>(places * kRegionCells * kRegionCells);
    l.far_slots = arena.in_scratch(l.num_far_slots * kSums * sizeof(float));
    if (in.config.loss.dssim > 0)
        l.maps =
            arena.in_scratch(10 * 3 * kViewsAtOnce * static_cast<size_t>(largest) * largest * sizeof(float));
    if (kSmall && arena.shared < shared_limit) {
        // The rest of the shared memory takes slots.
        l.num_near_slots = static_cast<uint32_t>((shared_limit - arena.shared) / (kSums * sizeof(float)));
        l.near_slots = {arena.in_shared(l.num_near_slots * kSums * sizeof(float)), true};
    }
    l.shared_bytes = arena.shared;
    l.scratch_bytes = (arena.scratch + 127) / 128 * 128;
    return l;
}

int attribute(cudaDeviceAttr name) {
    int device = 0, value = 0;
    check(cudaGetDevice(&device), "cudaGetDevice");
    check(cudaDeviceGetAttribute(&value, name, device), "cudaDeviceGetAttribute");
    return value;
}

// Returns whether kBlocks blocks fit on a multiprocessor; nothing happens where they do not.
template <int kThreads, int kBlocks, bool kSmall, int kChunk>
bool run(const FitGroupsInput& in, uint32_t most, int largest, cudaStream_t stream) {
    const size_t reserved = sizeof(Shared) + 1024;  // ours, and the driver's own of each block
    const size_t limit =
        (std::min<size_t>(attribute(cudaDevAttrMaxSharedMemoryPerBlockOptin) - sizeof(Shared),
                          attribute(cudaDevAttrMaxSharedMemoryPerMultiprocessor) / kBlocks - reserved)) /
        16 * 16;
    const size_t most_blocks = kBlocks * static_cast<size_t>(attribute(cudaDevAttrMultiProcessorCount));
    // For a group. Together they need to run at the same time.
    size_t num_blocks = 1;
    if (attribute(cudaDevAttrCooperativeLaunch) != 0)
        num_blocks =
            std::clamp<size_t>(most_blocks / in.jobs.size, 1,
                               kSmall ? std::min(in.config.views_per_step, kViewsAtOnce) : kLargestTeam);
    const size_t num_groups = std::min<size_t>(in.jobs.size, most_blocks / num_blocks);
    const Layout layout = layout_of<kThreads, kSmall, kChunk>(in, most, largest, num_blocks, limit);
    if (layout.shared_bytes > limit) return false;
    const DeviceBuffer<unsigned char> scratch(num_groups * (kSmall ? num_blocks : 1) * layout.scratch_bytes,
                                              stream);
    const DeviceBuffer<Team> teams(num_groups, stream);
    const DeviceBuffer<Queue> queue(1, stream);
    check(cudaMemsetAsync(teams.data(), 0, num_groups * sizeof(Team), stream), "cudaMemsetAsync");
    check(cudaMemsetAsync(queue.data(), 0, sizeof(Queue), stream), "cudaMemsetAsync");
    launch("fit_groups_kernel", fit_groups_kernel<kThreads, kBlocks, kSmall, kChunk>,
           static_cast<unsigned>(num_groups * num_blocks), kThreads, layout.shared_bytes, stream, in, layout,
           scratch.data(), static_cast<unsigned>(num_blocks), teams.data(), queue.data());
    return true;
}

}  // namespace

void fit_groups(const FitGroupsInput& in, Span<const FitJob> jobs, cudaStream_t stream) {
    uint32_t most = 0;
    int largest = 0;
    for (const FitJob& job : jobs) {
        most = std::max(most, static_cast<uint32_t>(job.group.count));
        largest = std::max(largest, job.size);
    }
    const bool is_small = most <= kSmallCount && largest <= kRegion;
    const bool are_many = jobs.size > static_cast<size_t>(attribute(cudaDevAttrMultiProcessorCount));
    // Where multiprocessors have less shared memory, with fewer threads.
    const bool runs = is_small ? (are_many && run<256, 2, true, 16>(in, most, largest, stream)) ||
                                     run<512, 1, true, 16>(in, most, largest, stream) ||
                                     run<256, 1, true, 16>(in, most, largest, stream)
                               : run<512, 1, false, 32>(in, most, largest, stream) ||
                                     run<256, 1, false, 16>(in, most, largest, stream);
    if (!runs) throw std::runtime_error("cuda: expected 96 KiB of shared memory in a block, got less");
}

}  // namespace cuda
}  // namespace v3dg
