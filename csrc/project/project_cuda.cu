// A block takes an item, a thread one of its gaussians.

#include "project/project_cuda.h"

#include "base/launch.cuh"
#include "tile_bin/warp_tiles.cuh"

namespace v3dg {
namespace cuda {

namespace {

// What the item's gaussians have in common.
struct ItemView {
    ModelView<float> view;
    Pinhole<float> camera;
    float filter_px2;
    bool compensate;
};

struct Candidate {
    bool in_frustum, reaches_pixel;
};

// Whether the sphere around a gaussian already tells that no pixel centre is reached. `found` is then all
// there is to know. Comparisons are such that whatever is not a number goes on to the full projection.
__device__ bool rejected_by_sphere(const ItemView& item, const float mean[3], const float scale[3],
                                   float opacity, Candidate& found) {
    const ModelView<float>& mv = item.view;
    const Pinhole<float>& cam = item.camera;
    const float x =
        mv.linear[0] * mean[0] + mv.linear[1] * mean[1] + mv.linear[2] * mean[2] + mv.translation[0];
    const float y =
        mv.linear[3] * mean[0] + mv.linear[4] * mean[1] + mv.linear[5] * mean[2] + mv.translation[1];
    const float z =
        mv.linear[6] * mean[0] + mv.linear[7] * mean[1] + mv.linear[8] * mean[2] + mv.translation[2];
    found = {false, false};
    if (!(z >= cam.near_depth)) return true;
    if (opacity < float(kMinAlpha)) return true;
    const float inv_z = 1 / z;
    const float u = cam.fx * x * inv_z + cam.cx, v = cam.fy * y * inv_z + cam.cy;
    const float unit =
        sqrt_of(mv.linear[6] * mv.linear[6] + mv.linear[7] * mv.linear[7] + mv.linear[8] * mv.linear[8]);
    const float sigma = unit * max_of(scale[0], max_of(scale[1], scale[2]));
    const float half_x = extent_bound(opacity, sigma, cam.fx * inv_z, x * inv_z, item.filter_px2);
    const float half_y = extent_bound(opacity, sigma, cam.fy * inv_z, y * inv_z, item.filter_px2);
    if (u + half_x <= 0 || u - half_x >= cam.width || v + half_y <= 0 || v - half_y >= cam.height)
        return true;
    // It counts as in the frustum when its centre is in the image, unless it has no area or its opacity
    // falls.
    if (item.compensate || !(u > 0 && u < cam.width && v > 0 && v < cam.height) ||
        !(min_of(scale[0], min_of(scale[1], scale[2])) > 0))
        return false;
    float x0, x1, y0, y1;
    pixel_span(u, half_x, cam.width, x0, x1);
    pixel_span(v, half_y, cam.height, y0, y1);
    if (ceilf(x0) > floorf(x1) || ceilf(y0) > floorf(y1)) {
        found.in_frustum = true;
        return true;
    }
    return false;
}

__device__ Candidate project_one(const ItemView& item, const DeviceRows& rows, size_t g, Record<float>& r) {
    Gaussian3d<float> gaussian;
    for (int k = 0; k < 3; ++k) gaussian.mean[k] = rows.means[3 * g + k];
    for (int k = 0; k < 3; ++k) gaussian.scale[k] = rows.scales[3 * g + k];
    gaussian.opacity = rows.opacities[g];
    Candidate found;
    if (rejected_by_sphere(item, gaussian.mean, gaussian.scale, gaussian.opacity, found)) return found;
    const float4 quat = reinterpret_cast<const float4*>(rows.quats)[g];
    gaussian.quat[0] = quat.x;
    gaussian.quat[1] = quat.y;
    gaussian.quat[2] = quat.z;
    gaussian.quat[3] = quat.w;
    Projection<float> s;
    const Ellipse<float> e =
        project_gaussian(gaussian, item.view, item.camera, item.filter_px2, item.compensate, s);
    float half_x, half_y;
    const Pinhole<float>& cam = item.camera;
    if (!extent_of(gaussian.opacity, e, s, half_x, half_y)) return found;
    found.in_frustum = meets_image(e.u, half_x, cam.width) && meets_image(e.v, half_y, cam.height);
    if (!found.in_frustum) return found;
    float low_x, high_x, low_y, high_y;
    pixel_span(e.u, half_x, cam.width, low_x, high_x);
    pixel_span(e.v, half_y, cam.height, low_y, high_y);
    const int x0 = max(0, static_cast<int>(ceilf(low_x))), y0 = max(0, static_cast<int>(ceilf(low_y)));
    const int x1 = min(static_cast<int>(cam.width) - 1, static_cast<int>(floorf(high_x)));
    const int y1 = min(static_cast<int>(cam.height) - 1, static_cast<int>(floorf(high_y)));
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
    float sh[3 * kMaxShBases];
    const float* row = rows.sh + g * (3 * num_sh_bases(rows.sh_degree));
    for (int k = 0; k < 3 * num_sh_bases(rows.sh_degree); ++k) sh[k] = row[k];
    color_of_sh(rows.sh_degree, gaussian.mean, item.view, sh, r.color);
    return found;
}

__global__ void __launch_bounds__(kItemSize) project_kernel(ProjectInput in, ProjectOutput out) {
    const FrameCounters& counters = *in.items.counters;
    const unsigned long long num_items = counters.items;
    if (num_items > in.items.item_capacity || counters.gaussians > in.items.record_capacity) return;
    __shared__ uint32_t warp_records[2][kItemSize / 32];
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    unsigned num_in_frustum = 0, num_records = 0;
    unsigned turn = 0;
    for (unsigned long long i = blockIdx.x; i < num_items; i += gridDim.x, turn ^= 1) {
        const DrawItem draw = in.items.items[i];
        const Placement& placement = in.placements[draw.placement];
        const FrameImage& image = in.images[placement.image];
        const ItemView item{placement.view, image.camera, draw.filter_px2, draw.compensate != 0};
        Candidate found{false, false};
        Record<float> r;
        if (threadIdx.x < draw.count)
            found = project_one(item, in.models[placement.model], size_t(draw.first) + threadIdx.x, r);

        const unsigned kept = __ballot_sync(kAllLanes, found.reaches_pixel);
        num_in_frustum += __popc(__ballot_sync(kAllLanes, found.in_frustum));
        if (lane == 0) warp_records[turn][warp] = __popc(kept);
        __syncthreads();
        unsigned before = 0, total = 0;
        for (unsigned w = 0; w < kItemSize / 32; ++w) {
            if (w < warp) before += warp_records[turn][w];
            total += warp_records[turn][w];
        }
        num_records += total;
        if (threadIdx.x == 0) out.item_records[i] = total;
        if (kept == 0) continue;

        TileBox box{0, 1, 0, 0};
        if (found.reaches_pixel) {
            const uint32_t at = draw.record + before + __popc(kept & ((1u << lane) - 1));
            out.records[at] = r;
            if (out.source != nullptr) out.source[at] = draw.first + threadIdx.x;
            box = tile_box(r, image);
            if (box.count > kFewTiles) {
                const unsigned long long place = atomicAdd(out.tiles.num_large, 1ull);
                if (place < out.large_capacity) out.large[place] = {at, placement.image};
                box.count = 0;
            }
        }
        for (unsigned k = 0; __any_sync(kAllLanes, k < box.count); ++k)
            count_tile(out.tiles.count, k < box.count ? box.tile(k) : kNoTile);
    }
    if (lane == 0) atomicAdd(&in.items.counters->in_frustum, static_cast<unsigned long long>(num_in_frustum));
    if (threadIdx.x == 0)
        atomicAdd(&in.items.counters->records, static_cast<unsigned long long>(num_records));
}

}  // namespace

void project(const ProjectInput& in, const ProjectOutput& out, cudaStream_t stream) {
    launch("project_kernel", project_kernel, 4 * num_multiprocessors(), kItemSize, 0, stream, in, out);
}

}  // namespace cuda
}  // namespace v3dg
