// A block takes an item, a thread one of its gaussians; blocks stay and take every so many items. What an
// item needs is fetched while the items before it are projected, each table a step after the one that points
// to it: the item four steps before its turn, its placement three, image and model two, the means one.

#include "project/project_cuda.h"

#include "base/launch.cuh"
#include "tile_bin/warp_tiles.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kWarps = kItemSize / 32;
constexpr unsigned kBlocks = 4;  // on a multiprocessor

// What an item needs, in shared memory.
template <class Model>
struct ItemTables {
    alignas(16) Placement placement;
    alignas(16) FrameImage image;
    DrawItem item;
    alignas(8) Model model;
    // Found from them.
    SlopeLimits<float> limits;
    float reach_scale;  // of a gaussian's reach, to px at depth 1; not a number where that bounds nothing
};
constexpr unsigned kRing = 8;  // items whose tables are held; a power of two

__device__ float4 load4(const float* from) { return __ldg(reinterpret_cast<const float4*>(from)); }

template <int kDegree>
__device__ void color_of(const float* rows, size_t g, const float mean[3], const ModelView<float>& view,
                         float color[3]) {
    constexpr int kSize = 3 * num_sh_bases(kDegree);
    float sh[kSize];
    const float* row = rows + g * kSize;
    if constexpr (kSize % 4 == 0) {
#pragma unroll
        for (int k = 0; k < kSize; k += 4) {
            const float4 x = load4(row + k);
            sh[k] = x.x;
            sh[k + 1] = x.y;
            sh[k + 2] = x.z;
            sh[k + 3] = x.w;
        }
    } else {
#pragma unroll
        for (int k = 0; k < kSize; ++k) sh[k] = __ldg(row + k);
    }
    color_of_sh(kDegree, mean, view, sh, color);
}

// Gaussians as users hold them.
struct RowSource {
    using Model = DeviceRows;

    // A gaussian's mean and reach, all that is read of most of those that reach no pixel centre.
    static __device__ float4 load_sphere(const DeviceRows& m, size_t g) {
        Gaussian3d<float> gaussian{
            {__ldg(m.means + 3 * g), __ldg(m.means + 3 * g + 1), __ldg(m.means + 3 * g + 2)},
            {1, 0, 0, 0},
            {},
            __ldg(m.opacities + g)};
        for (int k = 0; k < 3; ++k) gaussian.scale[k] = __ldg(m.scales + 3 * g + k);
        return {gaussian.mean[0], gaussian.mean[1], gaussian.mean[2], reach_of(gaussian)};
    }

    // `color` is that of degree 0.
    static __device__ Ellipse<float> project(const ItemTables<Model>& in, size_t g, const float4& sphere,
                                             Projection<float>& s, float color[3]) {
        const DeviceRows& m = in.model;
        Gaussian3d<float> gaussian{{sphere.x, sphere.y, sphere.z}, {}, {}, __ldg(m.opacities + g)};
        for (int k = 0; k < 3; ++k) gaussian.scale[k] = __ldg(m.scales + 3 * g + k);
        const float4 quat = load4(m.quats + 4 * g);
        gaussian.quat[0] = quat.x;
        gaussian.quat[1] = quat.y;
        gaussian.quat[2] = quat.z;
        gaussian.quat[3] = quat.w;
        if (m.sh_degree == 0) color_of<0>(m.sh, g, gaussian.mean, in.placement.view, color);
        return project_gaussian(gaussian, in.placement.view, in.image.camera, in.item.filter_px2,
                                in.item.compensate != 0, s);
    }
};

struct PackedSource {
    using Model = PackedRows;

    static __device__ float4 load_sphere(const PackedRows& m, size_t g) { return load4(m.planes + 4 * g); }

    static __device__ Ellipse<float> project(const ItemTables<Model>& in, size_t g, const float4& sphere,
                                             Projection<float>& s, float color[3]) {
        const PackedRows& m = in.model;
        const float4 a = load4(m.planes + 4 * (m.count + g)), b = load4(m.planes + 4 * (2 * m.count + g));
        const float4 c = load4(m.planes + 4 * (3 * m.count + g));
        color[0] = c.y;
        color[1] = c.z;
        color[2] = c.w;
        const PackedGaussian gaussian{
            {sphere.x, sphere.y, sphere.z}, sphere.w, {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w}, c.x};
        return project_packed(gaussian, in.placement.view, in.image.camera, in.limits, in.item.filter_px2,
                              in.item.compensate != 0, s);
    }
};

// A warp's records on their way out: written by lane, read in a row.
struct WarpRecords {
    uint4 word[3 * 32];
};

struct Candidate {
    bool in_frustum, reaches_pixel;
};

// Whether the sphere around a gaussian, at p in view space, already tells that no pixel centre is reached;
// `found` is then all there is to know. Whatever is not a number goes on to the full projection.
template <class Model>
__device__ bool is_told_by_sphere(const ItemTables<Model>& in, const float p[3], float reach,
                                  Candidate& found) {
    const Pinhole<float>& cam = in.image.camera;
    found = {false, false};
    if (!(p[2] >= cam.near_depth) || reach < 0) return true;
    const float inv_z = 1 / p[2], slope_x = p[0] * inv_z, slope_y = p[1] * inv_z;
    const float u = cam.fx * slope_x + cam.cx, v = cam.fy * slope_y + cam.cy;
    const float half = sphere_of_image(in.reach_scale * reach, inv_z, slope_x, slope_y, in.item.filter_px2);
    const float middle_x = 0.5f * cam.width, middle_y = 0.5f * cam.height;
    const float from_x = fabsf(u - middle_x), from_y = fabsf(v - middle_y);
    if (from_x - half >= middle_x || from_y - half >= middle_y) return true;
    // With its centre in the image it is in the frustum for certain, unless compensation makes it too faint.
    if (in.item.compensate || from_x >= middle_x || from_y >= middle_y) return false;
    found.in_frustum = misses_centers(u, half) || misses_centers(v, half);
    return found.in_frustum;
}

template <class Source>
__device__ Candidate project_one(const ItemTables<typename Source::Model>& in, const float4& sphere,
                                 Record<float>& r) {
    const ModelView<float>& view = in.placement.view;
    const float mean[3] = {sphere.x, sphere.y, sphere.z};
    Projection<float> s;
    for (int i = 0; i < 3; ++i)
        s.p[i] = view.linear[3 * i] * mean[0] + view.linear[3 * i + 1] * mean[1] +
                 view.linear[3 * i + 2] * mean[2] + view.translation[i];
    Candidate found;
    if (is_told_by_sphere(in, s.p, sphere.w, found)) return found;
    const size_t g = size_t(in.item.first) + threadIdx.x;
    const Ellipse<float> e = Source::project(in, g, sphere, s, r.color);
    float half_x, half_y;
    const Pinhole<float>& cam = in.image.camera;
    // is_told_by_sphere() has seen the opacity.
    if (!extent_of(1.0f, e, s, half_x, half_y)) return found;
    found.in_frustum = meets_image(e.u, half_x, cam.width) && meets_image(e.v, half_y, cam.height);
    if (!found.in_frustum) return found;
    float low_x, high_x, low_y, high_y;
    pixel_span(e.u, half_x, cam.width, low_x, high_x);
    pixel_span(e.v, half_y, cam.height, low_y, high_y);
    const int x0 = max(0, __float2int_ru(low_x)), x1 = min(in.image.width - 1, __float2int_rd(high_x));
    const int y0 = max(0, __float2int_ru(low_y)), y1 = min(in.image.height - 1, __float2int_rd(high_y));
    found.reaches_pixel = x0 <= x1 && y0 <= y1;
    if (!found.reaches_pixel) return found;

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
    switch (in.model.sh_degree) {
        case 0: break;
        case 1: color_of<1>(in.model.sh, g, mean, view, r.color); break;
        case 2: color_of<2>(in.model.sh, g, mean, view, r.color); break;
        default: color_of<3>(in.model.sh, g, mean, view, r.color);
    }
    return found;
}

// The word of a table that this lane fetches, and where it goes; nothing where `to` is null.
struct Fetch {
    const uint32_t* from = nullptr;
    uint32_t* to = nullptr;
};
template <class T>
__device__ Fetch fetch_word(const T& from, T& to) {
    static_assert(sizeof(T) <= 32 * sizeof(uint32_t), "a warp fetches a table");
    const unsigned lane = threadIdx.x % 32;
    if (lane >= sizeof(T) / sizeof(uint32_t)) return {};
    return {reinterpret_cast<const uint32_t*>(&from) + lane, reinterpret_cast<uint32_t*>(&to) + lane};
}

template <class Model>
__device__ void find_from_tables(ItemTables<Model>& in) {
    const float* linear = in.placement.view.linear;
    const float scale = sqrt_of(linear[6] * linear[6] + linear[7] * linear[7] + linear[8] * linear[8]);
    in.limits = slope_limits(in.image.camera);
    in.reach_scale = sees_its_axis(in.limits) ? max_of(in.image.camera.fx, in.image.camera.fy) * scale : NAN;
}

// Sum of four numbers whose sum is below 256.
__device__ unsigned sum_of_bytes(unsigned bytes) { return bytes * 0x01010101u >> 24; }

__device__ void put_record(const Record<float>& r, uint4* to) {
    to[0] = {__float_as_uint(r.u), __float_as_uint(r.v), __float_as_uint(r.l11), __float_as_uint(r.l12)};
    to[1] = {__float_as_uint(r.l22), __float_as_uint(r.log2_opacity), __float_as_uint(r.color[0]),
             __float_as_uint(r.color[1])};
    to[2] = {__float_as_uint(r.color[2]), __float_as_uint(r.depth), r.x0 | uint32_t(r.x1) << 16,
             r.y0 | uint32_t(r.y1) << 16};
}
static_assert(sizeof(Record<float>) == 3 * sizeof(uint4), "written as whole words");

template <class Source>
__global__ void __launch_bounds__(kItemSize, kBlocks)
    project_kernel(ProjectInput in, const typename Source::Model* models, ProjectOutput out) {
    FrameCounters& counters = *in.items.counters;
    if (counters.items > in.items.item_capacity || counters.gaussians > in.items.record_capacity) return;
    __shared__ ItemTables<typename Source::Model> ring[kRing];
    __shared__ WarpRecords staged[kWarps];
    __shared__ uint2 warp_records[2];  // a byte a warp
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const unsigned num_items = static_cast<unsigned>(counters.items);
    const unsigned warps_before[2] = {warp < 4 ? (1u << 8 * warp) - 1 : ~0u,
                                      warp < 5 ? 0 : (1u << 8 * (warp - 4)) - 1};
    unsigned num_in_frustum = 0, num_records = 0;
    float4 next_sphere = {0, 0, 0, 0};
    for (unsigned step = 0;; ++step) {
        // Item number n of this block is fetched in step n.
        const auto item_of = [&](unsigned n) { return blockIdx.x + n * gridDim.x; };
        Fetch fetch;
        if (warp < 4) {
            const unsigned n = step - min(warp, 2u);
            if (step >= min(warp, 2u) && item_of(n) < num_items) {
                auto& to = ring[n % kRing];
                if (warp == 0) fetch = fetch_word(in.items.items[item_of(n)], to.item);
                if (warp == 1) fetch = fetch_word(in.placements[to.item.placement], to.placement);
                if (warp == 2) fetch = fetch_word(in.images[to.placement.image], to.image);
                if (warp == 3) fetch = fetch_word(models[to.placement.model], to.model);
            }
        }
        uint32_t fetched = 0;
        if (fetch.to != nullptr) fetched = *fetch.from;
        const float4 sphere = next_sphere;
        if (step >= 3 && item_of(step - 3) < num_items) {
            auto& next = ring[(step - 3) % kRing];
            if (threadIdx.x < next.item.count)
                next_sphere = Source::load_sphere(next.model, size_t(next.item.first) + threadIdx.x);
            if (threadIdx.x == kItemSize - 1) find_from_tables(next);
        }
        const unsigned i = item_of(step - 4);
        if (step >= 4 && i >= num_items) break;

        const auto& tables = ring[(step - 4) % kRing];
        Candidate found{false, false};
        Record<float> r;
        if (step >= 4 && threadIdx.x < tables.item.count) found = project_one<Source>(tables, sphere, r);
        const unsigned kept = __ballot_sync(kAllLanes, found.reaches_pixel);
        num_in_frustum += found.in_frustum;
        if (lane == 0)
            reinterpret_cast<unsigned char*>(&warp_records[step % 2])[warp] =
                static_cast<unsigned char>(__popc(kept));
        if (fetch.to != nullptr) *fetch.to = fetched;
        __syncthreads();
        if (step < 4) continue;

        const uint2 counts = warp_records[step % 2];
        const unsigned total = sum_of_bytes(counts.x) + sum_of_bytes(counts.y);
        if (threadIdx.x == 0) {
            out.item_records[i] = total;
            num_records += total;
        }
        if (kept == 0) continue;

        const unsigned before =
            sum_of_bytes(counts.x & warps_before[0]) + sum_of_bytes(counts.y & warps_before[1]);
        const size_t first = tables.item.record + before;
        const unsigned rank = __popc(kept & ((1u << lane) - 1));
        TileBox box{0, 1, 0, 0};
        if (found.reaches_pixel) {
            put_record(r, staged[warp].word + 3 * rank);
            box = tile_box(r, tables.image);
            if (box.count > kFewTiles) {
                const unsigned long long place = atomicAdd(out.tiles.num_large, 1ull);
                if (place < out.large_capacity)
                    out.large[place] = {static_cast<uint32_t>(first + rank), tables.placement.image};
                box.count = 0;
            }
            if (out.source != nullptr) out.source[first + rank] = tables.item.first + threadIdx.x;
        }
        __syncwarp();
        uint4* records = reinterpret_cast<uint4*>(out.records + first);
        for (unsigned w = lane; w < 3 * __popc(kept); w += 32) records[w] = staged[warp].word[w];
        for (unsigned k = 0; __any_sync(kAllLanes, k < box.count); ++k)
            count_tile(out.tiles.count, k < box.count ? box.tile(k) : kNoTile);
    }
#pragma unroll
    for (int offset = 16; offset > 0; offset /= 2)
        num_in_frustum += __shfl_xor_sync(kAllLanes, num_in_frustum, offset);
    if (lane == 0) atomicAdd(&counters.in_frustum, static_cast<unsigned long long>(num_in_frustum));
    if (threadIdx.x == 0) atomicAdd(&counters.records, static_cast<unsigned long long>(num_records));
}

// A thread a gaussian.
__global__ void pack_kernel(DeviceRows rows, size_t count, float4* planes) {
    const size_t g = blockIdx.x * size_t(blockDim.x) + threadIdx.x;
    if (g >= count) return;
    Gaussian3d<float> gaussian;
    for (int k = 0; k < 3; ++k) gaussian.mean[k] = rows.means[3 * g + k];
    for (int k = 0; k < 4; ++k) gaussian.quat[k] = rows.quats[4 * g + k];
    for (int k = 0; k < 3; ++k) gaussian.scale[k] = rows.scales[3 * g + k];
    gaussian.opacity = rows.opacities[g];
    const PackedGaussian p = pack_gaussian(gaussian);
    planes[g] = {p.mean[0], p.mean[1], p.mean[2], p.reach};
    planes[count + g] = {p.f[0], p.f[1], p.f[2], p.f[3]};
    planes[2 * count + g] = {p.f[4], p.f[5], p.f[6], p.f[7]};
    float color[3];
    const float* sh = rows.sh + g * (3 * num_sh_bases(rows.sh_degree));
    color_of_sh(0, gaussian.mean, ModelView<float>{}, sh, color);
    planes[3 * count + g] = {p.log2_opacity, color[0], color[1], color[2]};
}

}  // namespace

PackedRows pack(const DeviceRows& rows, size_t count, float* planes, cudaStream_t stream) {
    constexpr unsigned kThreads = 256;
    launch("pack_kernel", pack_kernel, blocks_for(count, kThreads), kThreads, 0, stream, rows, count,
           reinterpret_cast<float4*>(planes));
    return {planes, count, rows.sh, rows.sh_degree};
}

void project(const ProjectInput& in, const ProjectOutput& out, cudaStream_t stream) {
    const unsigned blocks = kBlocks * num_multiprocessors();
    if (in.packed != nullptr)
        launch("project_kernel", project_kernel<PackedSource>, blocks, kItemSize, 0, stream, in, in.packed,
               out);
    else
        launch("project_kernel", project_kernel<RowSource>, blocks, kItemSize, 0, stream, in, in.models, out);
}

}  // namespace cuda
}  // namespace v3dg
