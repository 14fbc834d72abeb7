// The sensor pass on CUDA: a block for a tile, a thread for a pixel, which walks the
// list of its tile front to back.

#include "base/launch.cuh"
#include "frame/record.cuh"
#include "rasterize/sense.h"
#include "rasterize/sense_math.h"

namespace v3dg {
namespace cuda {
namespace {

constexpr int kSenseThreads = kFrameTileWidth * kFrameTileHeight;

__device__ SensedSums no_sums() { return {{0, 0, 0}, 0, {0, 0, 0}, 0, kMeshRecord}; }

// Adds a record with a positive weight to the sums of a pixel.
__device__ void add_record(const SenseInput& in, const Record<float>& g, uint32_t record,
                           float weight, SensedSums& sums) {
    for (int c = 0; c < 3; ++c) sums.color[c] += weight * g.color[c];
    sums.depth += weight * g.depth;
    if (weight > sums.weight) {
        sums.weight = weight;
        sums.record = record;
    }
    if (in.sensor.planes.normal == nullptr) return;
    const size_t row = in.source[record];
    float p[3], normal[3];
    to_view(in.view, in.rows.means + 3 * row, p);
    normal_of_gaussian(in.rows.quats + 4 * row, in.rows.scales + 3 * row, in.view, p, normal);
    for (int k = 0; k < 3; ++k) sums.normal[k] += weight * normal[k];
}

// A pixel while its list is walked. Until the mesh is reached, `behind` has the sums in
// front of it.
struct WalkedPixel {
    SensedPixel sums;
    float passes;      // part of the light that the mesh lets through
    bool awaits_mesh;  // whether the pixel has a mesh that it has not reached
};

__device__ WalkedPixel start_pixel(const MeshLayer& layer, size_t at) {
    WalkedPixel pixel{{1, 0, {0, 0, 0}, no_sums(), no_sums()}, 1, false};
    if (!layer.is_there()) return pixel;
    pixel.sums.mesh = {layer.coverage[at], layer.depth[at], 0};
    pixel.awaits_mesh = layer.coverage[at] > 0;
    return pixel;
}

__device__ void reach_mesh(WalkedPixel& pixel) {
    SensedPixel& sums = pixel.sums;
    sums.front = sums.behind;
    sums.behind = no_sums();
    sums.mesh.passed = sums.transmittance;
    pixel.awaits_mesh = false;
    pixel.passes = 1 - sums.mesh.coverage;
    sums.median_depth =
        median_after(sums.median_depth, sums.transmittance, pixel.passes, sums.mesh.depth);
    if (sums.mesh.coverage >= 1) sums.transmittance = -sums.transmittance;
}

// Ends a pixel. If it has not reached its mesh, the mesh is behind all gaussians, or
// hidden if the pixel has stopped.
__device__ void end_pixel(WalkedPixel& pixel) {
    if (pixel.awaits_mesh && pixel.sums.transmittance > 0) reach_mesh(pixel);
    if (pixel.awaits_mesh) pixel.sums.mesh.coverage = 0;
    if (pixel.sums.mesh.coverage > 0) return;
    pixel.sums.front = pixel.sums.behind;
    pixel.sums.behind = no_sums();
}

template <class Stop>
__global__ void __launch_bounds__(kSenseThreads) sense_kernel(SenseInput in, Stop stop) {
    const uint32_t tile = blockIdx.x;
    const int x = static_cast<int>(tile) % in.image.tile_columns * kFrameTileWidth +
                  static_cast<int>(threadIdx.x) % kFrameTileWidth;
    const int y = static_cast<int>(tile) / in.image.tile_columns * kFrameTileHeight +
                  static_cast<int>(threadIdx.x) / kFrameTileWidth;
    if (x >= in.image.width || y >= in.image.height) return;
    const size_t at = static_cast<size_t>(y) * in.image.width + x;
    WalkedPixel pixel = start_pixel(in.sensor.mesh, at);
    SensedPixel& sums = pixel.sums;
    const uint32_t* order = in.order + in.tile_first[tile];
    const uint32_t count = in.blended[tile];
    for (uint32_t i = 0; i < count && sums.transmittance > 0; ++i) {
        const Record<float> g = load_record(in.records, order[i], RecordBox{});
        if (pixel.awaits_mesh && g.depth >= sums.mesh.depth) {
            reach_mesh(pixel);
            if (sums.transmittance <= 0) break;
        }
        const Falloff<float> f =
            falloff_at(static_cast<float>(x) + 0.5f, static_cast<float>(y) + 0.5f, g.u, g.v, g.l11,
                       g.l12, g.l22, g.log2_opacity);
        const bool goes_on = blend_live(f, sums.transmittance, stop, [&](float weight) {
            add_record(in, g, order[i], weight, sums.behind);
        });
        if (!goes_on) sums.transmittance = -sums.transmittance;
        if (contributes(f))
            sums.median_depth =
                median_after(sums.median_depth, sums.transmittance, pixel.passes, g.depth);
    }
    end_pixel(pixel);
    const PicturePlanes& planes = in.image.planes;
    const Picture<float> picture{.window = {0, 0, in.image.width, in.image.height},
                                 .background = {},
                                 .color = planes.color,
                                 .alpha = planes.alpha,
                                 .depth = planes.depth};
    write_pixel(sums, at, in.min_transmittance, {nullptr, nullptr, nullptr}, in.sensor, picture);
}

}  // namespace

void sense(const SenseInput& in, cudaStream_t stream) {
    with_stop<float>(in.min_transmittance, [&](auto stop) {
        launch("sense_kernel", sense_kernel<decltype(stop)>, num_tiles_of(in.image), kSenseThreads,
               0, stream, in, stop);
    });
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

}  // namespace cuda
}  // namespace v3dg
