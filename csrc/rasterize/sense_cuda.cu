// The sensor pass on CUDA. After blending, it processes the records of each tile again,
// in the order stored in the tape.
//
// A block processes a tile, a warp 8 x 4 pixels, and a thread one pixel. The block
// loads the next batch of records while it processes the current one. As in blending,
// each lane finds the pixels that one of 32 records reaches. The masks are then
// transposed, so that each pixel visits only its own records.

#include "base/copy_async.cuh"
#include "rasterize/blend_batch.cuh"
#include "rasterize/rasterize.h"
#include "rasterize/sense.h"
#include "rasterize/sense_math.h"

namespace v3dg {
namespace cuda {
namespace {

constexpr int kSenseThreads = kFrameTilePixels;
constexpr int kSenseBlocks = 2;        // resident blocks per multiprocessor
constexpr uint32_t kSenseBatch = 128;  // number of records that are loaded together

// The records of a batch.
struct SensedBatch {
    float4 ellipse[kEllipseVectors][kSenseBatch];
    float2 rest[kSenseBatch];
    float normal[3][kSenseBatch];
    uint32_t record[kSenseBatch];
};

// Which outputs a kernel computes.
template <bool kHasMeshes, bool kHasNormals>
struct Sensing {
    static constexpr bool kMeshes = kHasMeshes, kNormals = kHasNormals;
};

// Starts loading a record into a batch.
template <class What>
__device__ void load_sensed(const RecordPlanes& records, const SensedRecords& sensed,
                            uint32_t record, uint32_t i, SensedBatch& batch) {
    const float4* ellipse = ellipse_of(records, record);
    for (int k = 0; k < kEllipseVectors; ++k) copy_async(&batch.ellipse[k][i], ellipse + k);
    copy_async(&batch.rest[i], rest_of(records, record));
    batch.record[i] = record;
    if constexpr (What::kNormals)
        for (int k = 0; k < 3; ++k) batch.normal[k][i] = sensed.normal[3 * size_t(record) + k];
}

__device__ SensedSums no_sums() { return {{0, 0, 0}, 0, {0, 0, 0}, 0, kMeshRecord}; }

// The state of a pixel. Until the mesh is reached, `sums.behind` collects the gaussians
// in front of it.
struct WalkedPixel {
    float x, y;  // pixel centre
    SensedPixel sums;
    float passes;      // fraction of the light that the mesh lets through
    bool awaits_mesh;  // whether the pixel's mesh is still ahead
    bool is_alive;     // whether more records may change the pixel
};

// Returns the mesh of a pixel. Values in device memory are not validated, so a mesh
// counts as absent if its depth is not positive and finite, or if its coverage is NaN.
__device__ SensedMesh mesh_at(const MeshLayer& layer, size_t at) {
    const float depth = layer.depth[at];
    const float coverage = layer.coverage == nullptr ? 1.0f : __saturatef(layer.coverage[at]);
    const bool is_one = depth > 0 && depth < INFINITY;
    return {is_one ? coverage : 0.0f, depth, 0};
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
    if (sums.mesh.coverage >= 1) {
        sums.transmittance = -sums.transmittance;
        pixel.is_alive = false;
    }
}

// Finishes a pixel whose mesh is still ahead. The mesh is behind all gaussians or, if
// the pixel has stopped, hidden.
__device__ void end_pixel(WalkedPixel& pixel) {
    if (pixel.awaits_mesh && pixel.sums.transmittance > 0) reach_mesh(pixel);
    if (pixel.awaits_mesh) pixel.sums.mesh.coverage = 0;
    if (pixel.sums.mesh.coverage > 0) return;
    pixel.sums.front = pixel.sums.behind;
    pixel.sums.behind = no_sums();
}

// Blends record i of the batch into the sums of a pixel.
template <class What, class Stop>
__device__ void sense_record(const SensedBatch& batch, uint32_t i, Stop stop, WalkedPixel& pixel) {
    SensedPixel& sums = pixel.sums;
    const float4 a = batch.ellipse[0][i], b = batch.ellipse[1][i];
    const float2 c = batch.rest[i];
    if (What::kMeshes && pixel.awaits_mesh && c.y >= sums.mesh.depth) {
        reach_mesh(pixel);
        if (!pixel.is_alive) return;
    }
    const Falloff<float> f = falloff_at(pixel.x, pixel.y, a.x, a.y, a.z, a.w, b.x, b.y);
    pixel.is_alive = blend_live(f, sums.transmittance, stop, [&](float weight) {
        SensedSums& into = sums.behind;
        if constexpr (What::kMeshes) {
            into.color[0] += weight * b.z;
            into.color[1] += weight * b.w;
            into.color[2] += weight * c.x;
            into.depth += weight * c.y;
        }
        if constexpr (What::kNormals)
            for (int k = 0; k < 3; ++k) into.normal[k] += weight * batch.normal[k][i];
        if (weight > into.weight) {
            into.weight = weight;
            into.record = batch.record[i];
        }
    });
    if (!pixel.is_alive) sums.transmittance = -sums.transmittance;
    if (contributes(f))
        sums.median_depth = median_after(sums.median_depth, sums.transmittance, pixel.passes, c.y);
}

// Walks the first `count` records of a batch. All lanes of the warp must call it.
// (corner_x, corner_y) is the centre of the warp's first pixel.
template <class What, class Stop>
__device__ void walk_batch(const SensedBatch& batch, uint32_t count, Stop stop, float corner_x,
                           float corner_y, WalkedPixel& pixel) {
    const uint32_t lane = threadIdx.x % 32;
    for (uint32_t first = 0; first < count; first += 32) {
        // Records are ordered by depth, so if this record is behind the mesh, all later
        // ones are.
        if (What::kMeshes && pixel.awaits_mesh && pixel.is_alive &&
            batch.rest[first].y >= pixel.sums.mesh.depth)
            reach_mesh(pixel);
        // The last lane takes the first record, so that this record becomes the highest
        // bit in the masks of pixels.
        const uint32_t own = first + 31 - lane;
        uint32_t bits = 0;
        if (own < count) {
            const float4 a = batch.ellipse[0][own], b = batch.ellipse[1][own];
            bits = reached_cells<1>(a.x - corner_x, a.y - corner_y, a.z, a.w, b.x, b.y);
        }
        if (!__any_sync(kAllLanes, bits != 0)) continue;
        bits = transpose_bits(bits);
        while (bits != 0 && pixel.is_alive) {
            const uint32_t highest = 31 - __clz(static_cast<int>(bits));
            bits = low_bits(bits, highest);
            sense_record<What>(batch, first + 31 - highest, stop, pixel);
        }
        __syncwarp();
    }
}

// Processes the list of a tile. All threads of the block must call it.
template <class What, class Stop>
__device__ void walk_list(const RecordPlanes& records, const SensedRecords& sensed,
                          const uint32_t* order, uint32_t count, Stop stop, float corner_x,
                          float corner_y, WalkedPixel& pixel) {
    __shared__ SensedBatch batches[2];
    const uint32_t i = threadIdx.x;
    const auto has_record = [&](uint32_t first) { return i < kSenseBatch && first + i < count; };
    const auto next_of = [&](uint32_t first) { return has_record(first) ? order[first + i] : 0; };
    if (has_record(0)) load_sensed<What>(records, sensed, order[i], i, batches[0]);
    uint32_t next = next_of(kSenseBatch);
    for (uint32_t first = 0; first < count; first += kSenseBatch) {
        wait_for_copies();
        // This synchronisation also ensures that no warp still uses the batch that is
        // overwritten next.
        if (!__syncthreads_or(pixel.is_alive)) break;
        const uint32_t turn = first / kSenseBatch % 2, after = first + kSenseBatch;
        if (has_record(after)) load_sensed<What>(records, sensed, next, i, batches[turn ^ 1]);
        next = next_of(after + kSenseBatch);
        if (__any_sync(kAllLanes, pixel.is_alive))
            walk_batch<What>(batches[turn], min(count - first, kSenseBatch), stop, corner_x,
                             corner_y, pixel);
    }
    wait_for_copies();
}

// Fills the channels of images that were not drawn, so that pixels of an earlier frame
// are not mistaken for results.
__device__ void mark_unsensed(const FrameLists& lists, const FrameSensors& sensors) {
    for (uint32_t k = blockIdx.x; k < lists.num_marked; k += gridDim.x) {
        const SensorPlanes planes = sensors.of(k).planes;
        const size_t num_pixels = size_t(lists.images[k].width) * lists.images[k].height;
        for (size_t at = threadIdx.x; at < num_pixels; at += kSenseThreads) {
            if (planes.median_depth != nullptr) planes.median_depth[at] = NAN;
            if (planes.weight != nullptr) planes.weight[at] = NAN;
            if (planes.instance != nullptr) planes.instance[at] = kNoInstance;
            if (planes.label != nullptr) planes.label[at] = kNoLabel;
            for (int c = 0; c < 3 && planes.normal != nullptr; ++c) planes.normal[3 * at + c] = NAN;
        }
    }
}

// Returns the blended picture of an image, into which meshes are mixed.
__device__ Picture<float> picture_of(const FrameLists& lists, uint32_t k) {
    const FrameImage& image = lists.images[k];
    const PicturePlanes& planes = image.planes.color != nullptr ? image.planes : lists.planes[k];
    const bool has_four = planes.has_four_channels;
    return {.window = {0, 0, image.width, image.height},
            .background = {},
            .color = planes.color,
            .alpha = has_four ? planes.color + 3 : planes.alpha,
            .depth = planes.depth,
            .color_step = has_four ? 4 : 3,
            .alpha_step = has_four ? 4 : 1};
}

template <class Stop>
__device__ Stop stop_at(float min_transmittance) {
    if constexpr (std::is_same_v<Stop, StopsBefore>)
        return {};
    else
        return {min_transmittance};
}

template <class What, class Stop>
__global__ void __launch_bounds__(kSenseThreads, kSenseBlocks)
    sense_kernel(FrameLists lists, RasterTape tape, SensedRecords records, FrameSensors sensors) {
    await_kernel_before();
    if (!lists.capacity.holds(*lists.counters)) {
        mark_unsensed(lists, sensors);
        return;
    }
    const TilePlan& plan = lists.plans[blockIdx.x];
    const uint32_t tile = plan.tile;
    if (tile == kNoTile) return;
    using Sub = SubTile<1>;
    const FrameImage& image = lists.images[plan.image];
    const int in_image = static_cast<int>(tile - image.first_tile);
    const int sub = threadIdx.x / 32, lane = threadIdx.x % 32;
    const int left =
        in_image % image.tile_columns * kFrameTileWidth + sub % Sub::kColumns * Sub::kWidth;
    const int top =
        in_image / image.tile_columns * kFrameTileHeight + sub / Sub::kColumns * Sub::kHeight;
    const int x = left + lane % 8, y = top + lane / 8;
    const bool is_inside = x < image.width && y < image.height;
    const size_t at = static_cast<size_t>(y) * image.width + x;
    const Sensor sensor = sensors.of(plan.image);
    WalkedPixel pixel{.x = static_cast<float>(x) + 0.5f,
                      .y = static_cast<float>(y) + 0.5f,
                      .sums = {1, 0, {0, 0, 0}, no_sums(), no_sums()},
                      .passes = 1,
                      .awaits_mesh = false,
                      .is_alive = is_inside};
    if constexpr (What::kMeshes) {
        if (is_inside) pixel.sums.mesh = mesh_at(sensor.mesh, at);
        pixel.awaits_mesh = pixel.sums.mesh.coverage > 0;
    }
    const float min_transmittance =
        stop_of_cut(lists.min_transmittance, lists.counters->choice.tolerance_px2);
    walk_list<What>(lists.records, records, tape.order + lists.tile_first[tile], tape.blended[tile],
                    stop_at<Stop>(min_transmittance), static_cast<float>(left) + 0.5f,
                    static_cast<float>(top) + 0.5f, pixel);
    if (!is_inside) return;
    end_pixel(pixel);
    write_pixel(pixel.sums, at, min_transmittance, records, sensor, picture_of(lists, plan.image));
}

template <class What>
void launch_sense(const FrameLists& lists, const RasterTape& tape, const SensedRecords& records,
                  const FrameSensors& sensors, cudaStream_t stream) {
    with_stop<float>(lists.min_transmittance, [&](auto stop) {
        launch_early("sense_kernel", sense_kernel<What, decltype(stop)>, lists.num_plans,
                     kSenseThreads, 0, stream, lists, tape, records, sensors);
    });
}

}  // namespace

void sense(const FrameLists& lists, const RasterTape& tape, const SensedRecords& records,
           const FrameSensors& sensors, cudaStream_t stream) {
    const bool has_meshes = sensors.first.mesh.is_there();
    const auto launch_with = [&]<class What>(What) {
        launch_sense<What>(lists, tape, records, sensors, stream);
    };
    if (has_meshes && sensors.needs_normals())
        launch_with(Sensing<true, true>{});
    else if (has_meshes)
        launch_with(Sensing<true, false>{});
    else if (sensors.needs_normals())
        launch_with(Sensing<false, true>{});
    else
        launch_with(Sensing<false, false>{});
}

}  // namespace cuda
}  // namespace v3dg
