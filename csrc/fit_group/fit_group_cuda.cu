// A block fits a group, start to end, then takes the next from a queue.
//
// One step: threads project gaussians and order them by depth; warps take 8 x 4 pixels of a view each, list
// the gaussians that reach them, blend them front to back, compare, and walk back; what a gaussian gets from
// each warp has its own slot, and slots are added up in a fixed order; threads carry that on to the
// parameters, and Adam moves them. So every run has the same result, whatever order warps and blocks come in.
//
// Small groups keep what is read again and again in shared memory, large ones in global memory.

#include "fit_group/fit_group_cuda.h"

#include <algorithm>
#include <cfloat>
#include <type_traits>

#include "base/launch.cuh"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr int kViewsAtOnce = 2;
// Masks of sub-tiles have a bit for each of those in a region; a larger picture takes several regions.
constexpr int kSubWidth = 8, kSubHeight = 4, kRegion = 32;
constexpr int kSubColumns = kRegion / kSubWidth, kSubTiles = kSubColumns * (kRegion / kSubHeight);
static_assert(kSubTiles == 32, "a mask is a word");
// Gaussians of a list whose blending is kept for the walk back. What came before is blended again.
constexpr int kChunk = 32;
constexpr int kAtOnce = 4;      // gaussians that a warp looks at together
constexpr int kSumStride = 12;  // of FalloffSums and colour, with room to spare
constexpr int kSums = 9;
constexpr uint32_t kHiddenKey = 0xfffffffeu;  // after all depths
constexpr uint32_t kSmallCount = 256;         // gaussians of a small group
constexpr int kStepsPerPoll = 16;

static_assert(sizeof(Record<float>) == 48, "loaded as three float4");

// Where a kernel's array lies: in the block's shared memory or its part of the scratch.
struct Place {
    size_t offset;
    bool is_shared;
};

struct Layout {
    // Hot: shared for small groups, in the scratch for large ones.
    size_t records, keys, mask, slot_first, order, lists, kept_transmittance;
    size_t list_size, kept_size;  // of a warp, bytes
    size_t fragments;             // shared
    // Cold: wherever there is room.
    Place value, m, v, by_view, sum, sort_keys, sums, near_slots;
    size_t far_slots, maps;  // scratch
    uint32_t num_near_slots;
    size_t shared_bytes, scratch_bytes;  // of a block
};

constexpr size_t kFragmentsBytes = kChunk * 33 * sizeof(float2) + 32 * sizeof(float4);

struct Cameras {
    ModelView<float> view[kViewsAtOnce];
    Pinhole<float> camera[kViewsAtOnce];
    const float4* target[kViewsAtOnce];
};

struct Shared {
    Cameras cameras[2];  // of this step and the next
    float error[kViewsAtOnce * kSubTiles][2];
    uint32_t warp_total[32];
    uint32_t ticket, unit;
    int cancel;
};

enum class Pass { measure, draw, train };

template <int kThreads, bool kSmall>
struct Fit {
    using Index = std::conditional_t<kSmall, uint16_t, uint32_t>;
    static constexpr int kWarps = kThreads / 32;

    const FitGroupsInput& in;
    const Layout& layout;
    Shared& s;
    unsigned char* const scratch;
    unsigned char* const hot;
    // The group.
    FitJob job{};
    uint32_t n = 0, n_padded = 0;
    int num_sh = 0;
    uint32_t num_values = 0;

    __device__ Fit(const FitGroupsInput& input, const Layout& l, Shared& shared, unsigned char* all_scratch)
        : in(input),
          layout(l),
          s(shared),
          scratch(all_scratch + blockIdx.x * l.scratch_bytes),
          hot(kSmall ? shared_memory() : scratch) {}

    __device__ Record<float>* records() const {
        return reinterpret_cast<Record<float>*>(hot + layout.records);
    }
    __device__ uint32_t* keys() const { return reinterpret_cast<uint32_t*>(hot + layout.keys); }
    __device__ uint32_t* mask() const { return reinterpret_cast<uint32_t*>(hot + layout.mask); }
    __device__ uint32_t* slot_first() const { return reinterpret_cast<uint32_t*>(hot + layout.slot_first); }
    __device__ Index* order() const { return reinterpret_cast<Index*>(hot + layout.order); }
    __device__ Index* list() const {
        return reinterpret_cast<Index*>(hot + layout.lists + threadIdx.x / 32 * layout.list_size);
    }
    __device__ float* kept_transmittance() const {
        return reinterpret_cast<float*>(hot + layout.kept_transmittance +
                                        threadIdx.x / 32 * layout.kept_size);
    }
    // [gaussian][pixel]: alpha and weight, then gradient by the exponent and weight. The spare column keeps
    // lanes that read one pixel each of their own gaussian out of each other's banks.
    __device__ float2* fragments() const {
        return reinterpret_cast<float2*>(shared_memory() + layout.fragments +
                                         threadIdx.x / 32 * kFragmentsBytes);
    }
    __device__ float4* d_pixels() const {
        return reinterpret_cast<float4*>(shared_memory() + layout.fragments +
                                         threadIdx.x / 32 * kFragmentsBytes + kChunk * 33 * sizeof(float2));
    }
    __device__ float* at(const Place& place) const {
        return reinterpret_cast<float*>((place.is_shared ? shared_memory() : scratch) + place.offset);
    }
    // A slot for each sub-tile that each record reaches.
    __device__ float* slots(uint32_t num) const {
        return num <= layout.num_near_slots ? at(layout.near_slots)
                                            : reinterpret_cast<float*>(scratch + layout.far_slots);
    }

    // ---- parameters: means, quaternions, log scales and logits, a plane each; then SH coefficients,
    // gaussian by gaussian

    __device__ void start() {
        float* value = at(layout.value);
        float *m = at(layout.m), *v = at(layout.v);
        const float inverse = 1 / job.group.radius;
        const FitRows& rows = in.rows;
        for (uint32_t i = threadIdx.x; i < n; i += kThreads) {
            const size_t from = job.group.first + i;
            for (int k = 0; k < 3; ++k) {
                value[k * n + i] = (rows.means[3 * from + k] - job.group.center[k]) * inverse;
                value[(7 + k) * n + i] = log_of_scale(rows.scales[3 * from + k] * inverse);
            }
            for (int k = 0; k < 4; ++k) value[(3 + k) * n + i] = rows.quats[4 * from + k];
            value[10 * n + i] = logit_of_opacity(rows.opacities[from]);
        }
        for (uint32_t k = threadIdx.x; k < num_sh * n; k += kThreads)
            value[11 * n + k] = rows.sh[num_sh * job.group.first + k];
        for (uint32_t k = threadIdx.x; k < num_values; k += kThreads) m[k] = v[k] = 0;
    }

    // Writes the values back in world units unless one of them is not finite; whether it did.
    __device__ bool write() const {
        const float* value = at(layout.value);
        bool finite = true;
        for (uint32_t k = threadIdx.x; k < num_values; k += kThreads)
            finite = finite && fabsf(value[k]) <= FLT_MAX;
        if (!__syncthreads_and(finite)) return false;
        const FitRows& rows = in.rows;
        const FitGroup& group = job.group;
        for (uint32_t i = threadIdx.x; i < n; i += kThreads) {
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
        for (uint32_t k = threadIdx.x; k < num_sh * n; k += kThreads)
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

    // Places of gaussians in a batch of views: view b has those from b * n_padded on.
    __device__ void project(const Cameras& cameras, int num_views) const {
        for (uint32_t j = threadIdx.x; j < num_views * n_padded; j += kThreads) {
            const uint32_t b = j / n_padded, i = j - b * n_padded;
            uint32_t key = kHiddenKey, reached = 0;
            if (i < n) {
                Record<float> r;
                if (project_one(i, cameras.view[b], cameras.camera[b], r)) {
                    records()[j] = r;
                    key = __float_as_uint(r.depth);
                    if (kSmall) reached = sub_tiles_of(r, 0, 0);
                }
            }
            keys()[j] = key;
            if (kSmall) mask()[j] = reached;
        }
        if (threadIdx.x == 0) {
            // What fills up the lists draws nothing.
            Record<float> nothing{};
            nothing.log2_opacity = -100;
            records()[num_views * n_padded] = nothing;
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
        float low_x, high_x, low_y, high_y;
        pixel_span(e.u, half_x, camera.width, low_x, high_x);
        pixel_span(e.v, half_y, camera.height, low_y, high_y);
        const int x0 = max(0, static_cast<int>(ceilf(low_x))), y0 = max(0, static_cast<int>(ceilf(low_y)));
        const int x1 = min(job.size - 1, static_cast<int>(floorf(high_x)));
        const int y1 = min(job.size - 1, static_cast<int>(floorf(high_y)));
        if (x0 > x1 || y0 > y1) return false;
        r.u = e.u;
        r.v = e.v;
        r.l11 = e.l11;
        r.l12 = e.l12;
        r.l22 = e.l22;
        r.log2_opacity = e.log2_opacity;
        r.depth = e.depth;
        r.x0 = static_cast<uint16_t>(x0);
        r.x1 = static_cast<uint16_t>(x1);
        r.y0 = static_cast<uint16_t>(y0);
        r.y1 = static_cast<uint16_t>(y1);
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

    // Sub-tiles of the region at (left, top) that the record may reach, a bit each, row by row.
    __device__ static uint32_t sub_tiles_of(const Record<float>& r, int left, int top) {
        const int x0 = max(r.x0 - left, 0), x1 = min(r.x1 - left, kRegion - 1);
        const int y0 = max(r.y0 - top, 0), y1 = min(r.y1 - top, kRegion - 1);
        if (x0 > x1 || y0 > y1) return 0;
        const EllipseRows<float> ellipse = ellipse_rows(r.l11, r.l12, r.l22, r.log2_opacity);
        const float u = r.u - static_cast<float>(left) - 0.5f, v = r.v - static_cast<float>(top) - 0.5f;
        uint32_t reached = 0;
        for (int row = y0 / kSubHeight; row <= y1 / kSubHeight; ++row) {
            const float low = static_cast<float>(kSubHeight * row) - v;
            float from, to;
            row_extent(ellipse, low, low + static_cast<float>(kSubHeight - 1), from, to);
            const int first = max(x0, static_cast<int>(ceilf(max_of(u + from, -1.0f))));
            const int last = min(x1, static_cast<int>(floorf(min_of(u + to, static_cast<float>(kRegion)))));
            if (first > last) continue;
            const uint32_t columns = (2u << last / kSubWidth) - (1u << first / kSubWidth);
            reached |= columns << (kSubColumns * row);
        }
        return reached;
    }

    // Orders the gaussians of each view by depth, ties by place.
    __device__ void sort(int num_views) const {
        if (kSmall)
            rank_by_counting(num_views);
        else
            for (int b = 0; b < num_views; ++b) sort_bitonic(b);
    }

    __device__ void rank_by_counting(int num_views) const {
        for (uint32_t j = threadIdx.x; j < num_views * n_padded; j += kThreads) {
            const uint32_t first = j / n_padded * n_padded, i = j - first, warp_first = i - threadIdx.x % 32;
            const uint4* all = reinterpret_cast<const uint4*>(keys() + first);
            const uint32_t key = keys()[j];
            uint32_t rank = 0;
            const auto count = [&](uint32_t begin, uint32_t end, const auto& before) {
                for (uint32_t k = begin; k < end; k += 4) {
                    const uint4 other = all[k / 4];
                    rank += before(other.x, k);
                    rank += before(other.y, k + 1);
                    rank += before(other.z, k + 2);
                    rank += before(other.w, k + 3);
                }
            };
            count(0, warp_first, [&](uint32_t other, uint32_t) { return other <= key; });
            count(warp_first, warp_first + 32,
                  [&](uint32_t other, uint32_t k) { return other < key + (k < i); });
            count(warp_first + 32, n_padded, [&](uint32_t other, uint32_t) { return other < key; });
            order()[first + rank] = static_cast<Index>(j);
        }
    }

    __device__ void sort_bitonic(int b) const {
        auto* sorted = reinterpret_cast<unsigned long long*>(at(layout.sort_keys));
        uint32_t size = 32;
        while (size < n) size *= 2;
        const uint32_t first = b * n_padded;
        for (uint32_t i = threadIdx.x; i < size; i += kThreads)
            sorted[i] =
                i < n ? static_cast<unsigned long long>(keys()[first + i]) << 32 | (first + i) : ~0ull;
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
            order()[first + i] = i < n ? static_cast<Index>(sorted[i]) : static_cast<Index>(first + i);
        __syncthreads();
    }

    // Large groups: which sub-tiles of a region each record reaches.
    __device__ void mark_region(int num_views, int left, int top) const {
        for (uint32_t j = threadIdx.x; j < num_views * n_padded; j += kThreads)
            mask()[j] = keys()[j] == kHiddenKey ? 0 : sub_tiles_of(records()[j], left, top);
    }

    // Gives each record its slots, and counts them.
    __device__ uint32_t assign_slots(int num_views) const {
        const uint32_t count = num_views * n_padded, each = (count + kThreads - 1) / kThreads;
        const uint32_t begin = min(count, threadIdx.x * each), end = min(count, begin + each);
        uint32_t own = 0;
        for (uint32_t j = begin; j < end; ++j) own += __popc(mask()[j]);
        uint32_t upto = own;
        for (int offset = 1; offset < 32; offset *= 2) {
            const uint32_t left = __shfl_up_sync(kAllLanes, upto, offset);
            if (threadIdx.x % 32 >= static_cast<unsigned>(offset)) upto += left;
        }
        if (threadIdx.x % 32 == 31) s.warp_total[threadIdx.x / 32] = upto;
        __syncthreads();
        uint32_t before = upto - own, total = 0;
        for (uint32_t w = 0; w < kWarps; ++w) {
            if (w < threadIdx.x / 32) before += s.warp_total[w];
            total += s.warp_total[w];
        }
        for (uint32_t j = begin; j < end; ++j) {
            slot_first()[j] = before;
            before += __popc(mask()[j]);
        }
        return total;
    }

    // ---- blending

    // A warp's 8 x 4 pixels, a lane each.
    struct Pixel {
        int x, y;
        float center_x, center_y;
        bool inside;
    };

    __device__ Pixel pixel_of(int sub_tile, int left, int top) const {
        const int lane = threadIdx.x % 32;
        const int x = left + sub_tile % kSubColumns * kSubWidth + lane % kSubWidth;
        const int y = top + sub_tile / kSubColumns * kSubHeight + lane / kSubWidth;
        return {x, y, static_cast<float>(x) + 0.5f, static_cast<float>(y) + 0.5f,
                x < job.size && y < job.size};
    }

    // Lists what reaches a sub-tile of view b, nearest first, filled up to whole steps of the walk.
    __device__ uint32_t make_list(int b, int sub_tile, uint32_t nothing) const {
        const uint32_t lane = threadIdx.x % 32;
        Index* const out = list();
        uint32_t length = 0;
        for (uint32_t i = lane; i < n_padded; i += 32) {
            const Index j = order()[b * n_padded + i];
            const bool reaches = (mask()[j] >> sub_tile & 1) != 0;
            const uint32_t all = __ballot_sync(kAllLanes, reaches);
            if (reaches) out[length + __popc(all & ((1u << lane) - 1))] = j;
            length += __popc(all);
        }
        if (lane < kAtOnce) out[length + lane] = static_cast<Index>(nothing);
        __syncwarp();
        return length;
    }

    // A record in three loads.
    struct Loaded {
        float4 a, b;  // u, v, l11, l12; l22, log2_opacity, red, green
        float4 c;     // blue, depth, box

        __device__ explicit Loaded(const Record<float>* r) {
            const float4* words = reinterpret_cast<const float4*>(r);
            a = words[0];
            b = words[1];
            c = words[2];
        }
        __device__ float alpha_at(float x, float y) const {
            return alpha_of(falloff_at(x, y, a.x, a.y, a.z, a.w, b.x, b.y));
        }
    };

    struct alignas(kAtOnce * sizeof(Index)) Entries {
        Index record[kAtOnce];
    };

    // Blends kAtOnce gaussians of the list from `first` on over the pixel.
    template <class Blended>
    __device__ void blend(const Pixel& p, uint32_t first, float& transmittance,
                          const Blended& blended) const {
        const Entries entries = *reinterpret_cast<const Entries*>(list() + first);
        float alpha[kAtOnce], color[kAtOnce][3];
#pragma unroll
        for (int q = 0; q < kAtOnce; ++q) {
            const Loaded r(records() + entries.record[q]);
            alpha[q] = r.alpha_at(p.center_x, p.center_y);
            color[q][0] = r.b.z;
            color[q][1] = r.b.w;
            color[q][2] = r.c.x;
        }
#pragma unroll
        for (int q = 0; q < kAtOnce; ++q) {
            const float weight = blend_weight(alpha[q], transmittance);
            blended(q, color[q], weight > 0 ? alpha[q] : 0.0f, weight);
        }
    }

    template <Pass kPass>
    __device__ void blend_sub_tile(const Cameras& cameras, int b, int sub_tile, int left, int top,
                                   uint32_t nothing, float* slots, const float* d_dssim,
                                   float* picture) const {
        const uint32_t lane = threadIdx.x % 32;
        const Pixel p = pixel_of(sub_tile, left, top);
        const size_t at = static_cast<size_t>(p.y) * job.size + p.x;
        const size_t num_pixels = static_cast<size_t>(job.size) * job.size;
        float4 target = make_float4(0, 0, 0, 0);
        if (kPass != Pass::draw && p.inside) target = cameras.target[b][at];
        const uint32_t length = make_list(b, sub_tile, nothing);
        if (kPass == Pass::train && length == 0) return;

        float2* const mine = fragments() + lane;  // this pixel's
        float* const kept = kept_transmittance() + lane;
        float color[3] = {0, 0, 0}, transmittance = p.inside ? 1 : -1;
        uint32_t done = 0;
        for (; done < length; done += kAtOnce) {
            if (done % kChunk == 0) {
                if (!__any_sync(kAllLanes, transmittance > 0)) break;
                if (kPass == Pass::train) kept[done] = transmittance;  // kChunk is 32, as are the lanes
            }
            blend(p, done, transmittance, [&](int q, const float* rgb, float alpha, float weight) {
                for (int c = 0; c < 3; ++c) color[c] += weight * rgb[c];
                if (kPass == Pass::train) mine[(done % kChunk + q) * 33] = make_float2(alpha, weight);
            });
        }
        if (kPass == Pass::draw) {
            if (p.inside)
                for (int c = 0; c < 3; ++c) picture[c * num_pixels + at] = color[c];
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
            if (lane == 0) {
                s.error[b * kSubTiles + sub_tile][0] = in_color;
                s.error[b * kSubTiles + sub_tile][1] = in_alpha;
            }
            return;
        }

        float d[4] = {0, 0, 0, 0};
        if (p.inside) {
            const LossWeights& loss = in.config.loss;
            const float pixels = static_cast<float>(num_pixels);
            const float d_color = loss.l1 / (3 * pixels), d_alpha = loss.alpha / pixels;
            for (int c = 0; c < 3; ++c) d[c] = l1_vjp(difference[c], d_color);
            d[3] = l1_vjp(difference[3], d_alpha);
            if (d_dssim != nullptr)
                for (int c = 0; c < 3; ++c) d[c] += d_dssim[c * num_pixels + at];
        }
        d_pixels()[lane] = make_float4(d[0], d[1], d[2], 0);

        // Back to front, a chunk at a time; the last is still there.
        float behind = 0;
        const uint32_t filled = min(done, length);
        for (uint32_t end = done; end > 0;) {
            const uint32_t begin = (end - 1) / kChunk * kChunk;
            if (end < done) {
                transmittance = kept[begin];
                for (uint32_t i = begin; i < end; i += kAtOnce)
                    blend(p, i, transmittance, [&](int q, const float*, float alpha, float weight) {
                        mine[(i % kChunk + q) * 33] = make_float2(alpha, weight);
                    });
            }
            for (uint32_t i = end; i > begin;) {
                i -= kAtOnce;
                const Entries entries = *reinterpret_cast<const Entries*>(list() + i);
                float2 blended[kAtOnce];
                float by_weight[kAtOnce];
#pragma unroll
                for (int q = 0; q < kAtOnce; ++q) {
                    const Loaded r(records() + entries.record[q]);
                    blended[q] = mine[(i % kChunk + q) * 33];
                    by_weight[q] = d[0] * r.b.z + d[1] * r.b.w + d[2] * r.c.x + d[3];
                }
#pragma unroll
                for (int q = kAtOnce - 1; q >= 0; --q)
                    mine[(i % kChunk + q) * 33].x =
                        exponent_vjp_from_behind(blended[q].x, blended[q].y, by_weight[q], behind);
            }
            __syncwarp();
            if (begin + lane < filled) add_up(p, sub_tile, list()[begin + lane], slots);
            __syncwarp();
            end = begin;
        }
        for (uint32_t i = filled + lane; i < length; i += 32) {
            float* slot = slot_of(list()[i], sub_tile, slots);
            for (int k = 0; k < kSums; ++k) slot[k] = 0;
        }
    }

    __device__ float* slot_of(uint32_t j, int sub_tile, float* slots) const {
        return slots + kSums * (slot_first()[j] + __popc(mask()[j] & ((1u << sub_tile) - 1)));
    }

    // Sums for record j, which is this lane's, over the sub-tile's pixels.
    __device__ void add_up(const Pixel& p, int sub_tile, uint32_t j, float* slots) const {
        const Loaded r(records() + j);
        const uint32_t lane = threadIdx.x % 32;
        const float2* theirs = fragments() + 33 * lane;
        const float4* d = d_pixels();
        const float u = r.a.x, v = r.a.y, l11 = r.a.z, l12 = r.a.w, l22 = r.b.x;
        const float left = p.center_x - static_cast<float>(lane % kSubWidth),
                    top = p.center_y - static_cast<float>(lane / kSubWidth);
        FalloffSums<float> sums{};
        float color[3] = {0, 0, 0};
#pragma unroll 1
        for (int y = 0; y < kSubHeight; ++y) {
            float exponent = 0, t1 = 0, t1_dx = 0;
            Falloff<float> f;
#pragma unroll
            for (int x = 0; x < kSubWidth; ++x) {
                const float2 fragment = theirs[y * kSubWidth + x];
                const float4 d_color = d[y * kSubWidth + x];
                f = falloff_at(left + x, top + y, u, v, l11, l12, l22, 0.0f);
                const float d_t1 = fragment.x * f.t1;
                exponent += fragment.x;
                t1 += d_t1;
                t1_dx += d_t1 * f.dx;
                color[0] += fragment.y * d_color.x;
                color[1] += fragment.y * d_color.y;
                color[2] += fragment.y * d_color.z;
            }
            // The exponent is less by t1² + t2².
            sums.exponent += exponent;
            sums.t1 -= 2 * t1;
            sums.t1_dx -= 2 * t1_dx;
            sums.t1_dy -= 2 * t1 * f.dy;
            sums.t2 -= 2 * f.t2 * exponent;
            sums.t2_dy -= 2 * f.t2 * exponent * f.dy;
        }
        float* slot = slot_of(j, sub_tile, slots);
        slot[0] = sums.exponent;
        slot[1] = sums.t1;
        slot[2] = sums.t2;
        slot[3] = sums.t1_dx;
        slot[4] = sums.t1_dy;
        slot[5] = sums.t2_dy;
        for (int c = 0; c < 3; ++c) slot[6 + c] = color[c];
    }

    // Warps take sub-tiles of all views.
    template <Pass kPass>
    __device__ void blend_region(const Cameras& cameras, int num_views, int left, int top, float* slots,
                                 const float* d_dssim, float* picture) const {
        const int columns = min(kSubColumns, (job.size - left + kSubWidth - 1) / kSubWidth);
        const int rows = min(kSubTiles / kSubColumns, (job.size - top + kSubHeight - 1) / kSubHeight);
        const uint32_t num_units = num_views * columns * rows;
        for (;;) {
            uint32_t unit = 0;
            if (threadIdx.x % 32 == 0) unit = atomicAdd(&s.unit, 1u);
            unit = __shfl_sync(kAllLanes, unit, 0);
            if (unit >= num_units) return;
            const int b = unit / (columns * rows), place = unit % (columns * rows);
            const size_t num_pixels = static_cast<size_t>(job.size) * job.size;
            blend_sub_tile<kPass>(cameras, b, place / columns * kSubColumns + place % columns, left, top,
                                  num_views * n_padded, slots,
                                  d_dssim == nullptr ? nullptr : d_dssim + 3 * b * num_pixels,
                                  picture == nullptr ? nullptr : picture + 3 * b * num_pixels);
            __syncwarp();
        }
    }

    // ---- D-SSIM

    // Adds to nothing: writes the gradient of D-SSIM by the pictures, three planes each.
    __device__ void dssim_backward(const Cameras& cameras, int num_views, const float* pictures,
                                   float* d_pictures, float* maps) const {
        const int size = job.size;
        const uint32_t n_pixels = size * size;
        const float scale = -in.config.loss.dssim / (3 * static_cast<float>(n_pixels));
        for (int plane = 0; plane < 3 * num_views; ++plane) {
            const float* picture = pictures + static_cast<size_t>(plane) * n_pixels;
            float* d_picture = d_pictures + static_cast<size_t>(plane) * n_pixels;
            const float* target = &cameras.target[plane / 3]->x + plane % 3;
            float *d_x = maps + 5 * n_pixels, *d_xx = d_x + n_pixels, *d_xy = d_xx + n_pixels;
            // The window's sums along rows, then along columns.
            for (uint32_t i = threadIdx.x; i < n_pixels; i += kThreads) {
                const int x = i % size;
                SsimSums sums{};
#pragma unroll
                for (int k = -kSsimRadius; k <= kSsimRadius; ++k)
                    if (x + k >= 0 && x + k < size)
                        add(sums, ssim_weight(k), picture[i + k], target[4 * static_cast<size_t>(i + k)]);
                maps[i] = sums.x;
                maps[n_pixels + i] = sums.y;
                maps[2 * n_pixels + i] = sums.xx;
                maps[3 * n_pixels + i] = sums.yy;
                maps[4 * n_pixels + i] = sums.xy;
            }
            __syncthreads();
            for (uint32_t i = threadIdx.x; i < n_pixels; i += kThreads) {
                const int y = i / size;
                float sums[5] = {0, 0, 0, 0, 0};
#pragma unroll
                for (int k = -kSsimRadius; k <= kSsimRadius; ++k)
                    if (y + k >= 0 && y + k < size)
                        for (int map = 0; map < 5; ++map)
                            sums[map] += ssim_weight(k) * maps[map * n_pixels + i + k * size];
                const Ssim ssim = ssim_of({sums[0], sums[1], sums[2], sums[3], sums[4]});
                d_x[i] = scale * ssim.d_x;
                d_xx[i] = scale * ssim.d_xx;
                d_xy[i] = scale * ssim.d_xy;
            }
            __syncthreads();
            // Back through the window, which is its own transpose.
            for (uint32_t i = threadIdx.x; i < n_pixels; i += kThreads) {
                const int x = i % size;
                float sums[3] = {0, 0, 0};
#pragma unroll
                for (int k = -kSsimRadius; k <= kSsimRadius; ++k)
                    if (x + k >= 0 && x + k < size)
                        for (int map = 0; map < 3; ++map)
                            sums[map] += ssim_weight(k) * d_x[map * n_pixels + i + k];
                for (int map = 0; map < 3; ++map) maps[map * n_pixels + i] = sums[map];
            }
            __syncthreads();
            for (uint32_t i = threadIdx.x; i < n_pixels; i += kThreads) {
                const int y = i / size;
                float sums[3] = {0, 0, 0};
#pragma unroll
                for (int k = -kSsimRadius; k <= kSsimRadius; ++k)
                    if (y + k >= 0 && y + k < size)
                        for (int map = 0; map < 3; ++map)
                            sums[map] += ssim_weight(k) * maps[map * n_pixels + i + k * size];
                d_picture[i] =
                    sums[0] + 2 * picture[i] * sums[1] + target[4 * static_cast<size_t>(i)] * sums[2];
            }
            __syncthreads();
        }
    }

    __device__ static void add(SsimSums& sums, float weight, float x, float y) {
        sums.x += weight * x;
        sums.y += weight * y;
        sums.xx += weight * x * x;
        sums.yy += weight * y * y;
        sums.xy += weight * x * y;
    }

    // ---- the way back

    // Adds up each record's slots, onto what earlier regions gave.
    __device__ void sum_slots(int num_views, const float* slots, bool is_first_region) const {
        float* sums = at(layout.sums);
        for (uint32_t q = threadIdx.x; q < num_views * n_padded * kSums; q += kThreads) {
            const uint32_t j = q / kSums, k = q - j * kSums;
            const uint32_t first = slot_first()[j], count = __popc(mask()[j]);
            float sum = is_first_region ? 0 : sums[kSumStride * j + k];
            for (uint32_t t = first; t < first + count; ++t) sum += slots[kSums * t + k];
            sums[kSumStride * j + k] = sum;
        }
    }

    // From the sums of records to gradients of the parameters, for each view.
    __device__ void project_backward(const Cameras& cameras, int num_views) const {
        const float* sums = at(layout.sums);
        const float* value = at(layout.value);
        for (uint32_t j = threadIdx.x; j < num_views * n_padded; j += kThreads) {
            const uint32_t b = j / n_padded, i = j - b * n_padded;
            if (i >= n) continue;
            float* out = at(layout.by_view) + static_cast<size_t>(b) * num_values;
            float* d_sh = out + 11 * n + num_sh * i;
            if (keys()[j] == kHiddenKey) {
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
    __device__ void move(int num_views, bool is_first, bool is_last, int index) const {
        float *value = at(layout.value), *m = at(layout.m), *v = at(layout.v), *sum = at(layout.sum);
        const float* by_view = at(layout.by_view);
        const FitStep step = in.steps[index];
        const float position = position_step(in.config, job.group, step);
        for (uint32_t k = threadIdx.x; k < num_values; k += kThreads) {
            float gradient = is_first ? 0 : sum[k];
            for (int b = 0; b < num_views; ++b) gradient += by_view[b * num_values + k];
            if (!is_last) {
                sum[k] = gradient;
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
            value[k] = adam_step(value[k], gradient, m[k], v[k], size, step.correction1, step.correction2);
        }
    }

    // ---- a batch of views, and all of them

    template <class Body>
    __device__ void for_each_region(const Body& body) const {
        const int size = kSmall ? kRegion : job.size;
        for (int top = 0; top < size; top += kRegion)
            for (int left = 0; left < size; left += kRegion) body(left, top);
    }

    // Adds the |difference| of colour and alpha, summed over pixels, in every thread.
    __device__ void measure(const Cameras& cameras, int num_views, double error[2]) const {
        for_each_region([&](int left, int top) {
            if (!kSmall) mark_region(num_views, left, top);
            for (uint32_t t = threadIdx.x; t < kViewsAtOnce * kSubTiles; t += kThreads)
                s.error[t][0] = s.error[t][1] = 0;
            __syncthreads();
            blend_region<Pass::measure>(cameras, num_views, left, top, nullptr, nullptr, nullptr);
            __syncthreads();
            for (int t = 0; t < num_views * kSubTiles; ++t)
                for (int k = 0; k < 2; ++k) error[k] += static_cast<double>(s.error[t][k]);
            if (threadIdx.x == 0) s.unit = 0;
            __syncthreads();
        });
    }

    // Leaves the gradients of the parameters, for each view.
    __device__ void differentiate(const Cameras& cameras, int num_views) const {
        const float* d_dssim = nullptr;
        if (in.config.loss.dssim > 0) {
            const size_t planes = static_cast<size_t>(3 * kViewsAtOnce) * job.size * job.size;
            float* picture = reinterpret_cast<float*>(scratch + layout.maps);
            for_each_region([&](int left, int top) {
                if (!kSmall) mark_region(num_views, left, top);
                __syncthreads();
                blend_region<Pass::draw>(cameras, num_views, left, top, nullptr, nullptr, picture);
                __syncthreads();
                if (threadIdx.x == 0) s.unit = 0;
            });
            dssim_backward(cameras, num_views, picture, picture + planes, picture + 2 * planes);
            d_dssim = picture + planes;
        }
        for_each_region([&](int left, int top) {
            if (!kSmall) {
                mark_region(num_views, left, top);
                __syncthreads();
            }
            float* const slots = this->slots(assign_slots(num_views));
            __syncthreads();
            blend_region<Pass::train>(cameras, num_views, left, top, slots, d_dssim, nullptr);
            __syncthreads();
            sum_slots(num_views, slots, left == 0 && top == 0);
            if (threadIdx.x == 0) s.unit = 0;
            if (!kSmall) __syncthreads();
        });
        __syncthreads();
        project_backward(cameras, num_views);
        __syncthreads();
    }

    // The residual's views, those of all steps, and the residual's again, in batches of at most kViewsAtOnce.
    __device__ void fit() {
        const FitConfig& config = in.config;
        const int views_per_step = config.views_per_step, num_residual = num_residual_views(config);
        const int64_t num_visits = static_cast<int64_t>(config.steps) * views_per_step;
        // Visits of steps count from 0; the residual's lie before and after.
        const auto views_at = [&](int64_t visit) {
            const int64_t left = visit < 0            ? -visit
                                 : visit < num_visits ? views_per_step - visit % views_per_step
                                                      : num_visits + num_residual - visit;
            return static_cast<int>(min(static_cast<int64_t>(kViewsAtOnce), left));
        };
        const auto look_from = [&](Cameras& cameras, int64_t first) {
            const int b = threadIdx.x;
            if (b >= views_at(first)) return;
            const int64_t visit = first + b;
            uint64_t picture;
            if (visit >= 0 && visit < num_visits) {
                picture = visited_view(config, in.stride, visit);
            } else {
                const int i = static_cast<int>(visit < 0 ? visit + num_residual : visit - num_visits);
                picture = config.num_views > 0 ? residual_view(config, in.stride, i) : num_visits + i;
            }
            look(cameras, b, picture);
        };
        double error[2][2] = {{0, 0}, {0, 0}};  // before and after
        start();
        look_from(s.cameras[0], -num_residual);
        if (threadIdx.x == 0) s.unit = 0;
        __syncthreads();
        int turn = 0;
        for (int64_t visit = -num_residual; visit < num_visits + num_residual; turn ^= 1) {
            const int num_views = views_at(visit);
            const Cameras& cameras = s.cameras[turn];
            project(cameras, num_views);
            __syncthreads();
            sort(num_views);
            if (visit < 0 || visit >= num_visits) {
                __syncthreads();
                measure(cameras, num_views, error[visit >= 0]);
                look_from(s.cameras[turn ^ 1], visit + num_views);
            } else {
                const int index = static_cast<int>(visit / views_per_step),
                          within = static_cast<int>(visit % views_per_step);
                if (threadIdx.x == 0 && within == 0 && index % kStepsPerPoll == 0)
                    s.cancel = *static_cast<volatile int*>(&in.signals->cancel);
                differentiate(cameras, num_views);
                if (s.cancel) return;
                look_from(s.cameras[turn ^ 1], visit + num_views);
                move(num_views, within == 0, within + num_views == views_per_step, index);
            }
            __syncthreads();
            visit += num_views;
        }
        const double num_pixels = static_cast<double>(job.size) * job.size * num_residual;
        for (auto& e : error) {
            e[0] /= 3 * num_pixels;
            e[1] /= num_pixels;
        }
        const bool better = num_visits > 0 &&
                            residual_loss(config.loss, error[1]) <= residual_loss(config.loss, error[0]) &&
                            write();
        if (threadIdx.x != 0) return;
        for (int k = 0; k < 2; ++k) in.error[2 * job.error + k] = static_cast<float>(error[better][k]);
    }
};

// Counters of the queue, on the device.
struct Queue {
    unsigned next;
    unsigned long long groups_done, loss_sum;
};

template <int kThreads, int kBlocks, bool kSmall>
__global__ void __launch_bounds__(kThreads, kBlocks)
    fit_groups_kernel(const FitGroupsInput in, const Layout layout, unsigned char* scratch, Queue* queue) {
    __shared__ Shared s;
    Fit<kThreads, kSmall> fit(in, layout, s, scratch);
    for (;;) {
        if (threadIdx.x == 0) {
            s.ticket = atomicAdd(&queue->next, 1u);
            s.cancel = *static_cast<volatile int*>(&in.signals->cancel);
        }
        __syncthreads();
        const uint32_t ticket = s.ticket;
        if (ticket >= in.jobs.size || s.cancel) return;
        fit.job = in.jobs.data[ticket];
        fit.n = static_cast<uint32_t>(fit.job.group.count);
        fit.n_padded = (fit.n + 31) / 32 * 32;
        fit.num_sh = 3 * num_sh_bases(in.rows.sh_degree);
        fit.num_values = fit.n * (11 + fit.num_sh);
        fit.fit();
        __syncthreads();
        if (s.cancel) return;
        if (threadIdx.x != 0) continue;
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
    Place anywhere(size_t bytes) {
        const bool fits = shared + rounded(bytes) <= shared_limit;
        return {fits ? in_shared(bytes) : in_scratch(bytes), fits};
    }
};

Layout layout_of(const FitGroupsInput& in, uint32_t most, int largest, bool is_small, int num_warps,
                 size_t shared_limit) {
    Layout l{};
    Arena arena{shared_limit};
    const auto hot = [&](size_t bytes) {
        return is_small ? arena.in_shared(bytes) : arena.in_scratch(bytes);
    };
    const size_t padded = (most + 31) / 32 * 32;
    const size_t views = static_cast<size_t>(std::min(in.config.views_per_step, kViewsAtOnce));
    const size_t all = kViewsAtOnce * padded;  // a residual takes kViewsAtOnce in any case
    const size_t index = is_small ? sizeof(uint16_t) : sizeof(uint32_t);
    const size_t values = most * (11 + 3 * static_cast<size_t>(num_sh_bases(in.rows.sh_degree)));
    l.records = hot((all + 1) * sizeof(Record<float>));
    l.keys = hot(all * sizeof(uint32_t));
    l.mask = hot(all * sizeof(uint32_t));
    l.slot_first = hot(all * sizeof(uint32_t));
    l.order = hot(all * index);
    l.list_size = Arena::rounded((padded + kAtOnce) * index);
    l.lists = hot(num_warps * l.list_size);
    l.kept_size = (padded + kChunk) / kChunk * 32 * sizeof(float);
    l.kept_transmittance = hot(num_warps * l.kept_size);
    l.fragments = arena.in_shared(num_warps * kFragmentsBytes);
    if (!is_small) {
        size_t size = 32;
        while (size < most) size *= 2;
        l.sort_keys = arena.anywhere(size * sizeof(unsigned long long));
    }
    // Gradients come when the fragments are done with.
    const size_t by_view = views * values * sizeof(float);
    l.by_view = by_view <= num_warps * kFragmentsBytes ? Place{l.fragments, true} : arena.anywhere(by_view);
    // Small groups' sums take the place of their records.
    static_assert(kSumStride * sizeof(float) == sizeof(Record<float>), "");
    l.sums = is_small ? Place{l.records, true} : arena.anywhere(views * padded * kSumStride * sizeof(float));
    l.value = arena.anywhere(values * sizeof(float));
    l.m = {arena.in_scratch(values * sizeof(float)), false};
    l.v = {arena.in_scratch(values * sizeof(float)), false};
    l.sum = {arena.in_scratch(values * sizeof(float)), false};
    l.far_slots = arena.in_scratch(views * padded * kSubTiles * kSums * sizeof(float));
    if (in.config.loss.dssim > 0)
        l.maps =
            arena.in_scratch((6 * kViewsAtOnce + 8) * static_cast<size_t>(largest) * largest * sizeof(float));
    // The rest of the shared memory takes slots.
    l.num_near_slots = static_cast<uint32_t>((shared_limit - arena.shared) / (kSums * sizeof(float)));
    l.near_slots = {arena.in_shared(l.num_near_slots * kSums * sizeof(float)), true};
    l.shared_bytes = arena.shared;
    l.scratch_bytes = Arena::rounded(arena.scratch + 127) / 128 * 128;
    return l;
}

int attribute(cudaDeviceAttr name) {
    int device = 0, value = 0;
    check(cudaGetDevice(&device), "cudaGetDevice");
    check(cudaDeviceGetAttribute(&value, name, device), "cudaDeviceGetAttribute");
    return value;
}

template <int kThreads, int kBlocks, bool kSmall>
void run(const FitGroupsInput& in, uint32_t most, int largest, cudaStream_t stream) {
    const size_t reserved = sizeof(Shared) + 1024;  // the driver's own, and ours
    const size_t limit =
        std::min<size_t>(attribute(cudaDevAttrMaxSharedMemoryPerBlockOptin) - sizeof(Shared),
                         attribute(cudaDevAttrMaxSharedMemoryPerMultiprocessor) / kBlocks - reserved) /
        16 * 16;
    const Layout layout = layout_of(in, most, largest, kSmall, kThreads / 32, limit);
    const size_t blocks = std::min<size_t>(in.jobs.size, kBlocks * attribute(cudaDevAttrMultiProcessorCount));
    const DeviceBuffer<unsigned char> scratch(blocks * layout.scratch_bytes, stream);
    const DeviceBuffer<Queue> queue(1, stream);
    check(cudaMemsetAsync(queue.data(), 0, sizeof(Queue), stream), "cudaMemsetAsync");
    launch("fit_groups_kernel", fit_groups_kernel<kThreads, kBlocks, kSmall>, static_cast<unsigned>(blocks),
           kThreads, layout.shared_bytes, stream, in, layout, scratch.data(), queue.data());
}

}  // namespace

void fit_groups(const FitGroupsInput& in, Span<const FitJob> jobs, cudaStream_t stream) {
    uint32_t most = 0;
    int largest = 0;
    for (const FitJob& job : jobs) {
        most = std::max(most, static_cast<uint32_t>(job.group.count));
        largest = std::max(largest, job.size);
    }
    if (most > kSmallCount || largest > kRegion)
        run<512, 1, false>(in, most, largest, stream);
    else if (jobs.size > static_cast<size_t>(attribute(cudaDevAttrMultiProcessorCount)))
        run<256, 2, true>(in, most, largest, stream);
    else
        run<512, 1, true>(in, most, largest, stream);
}

}  // namespace cuda
}  // namespace v3dg
