// Marks clipped pixels. A thread places an instance in front of a camera, as for the
// cut of a batch. Then a block tests the clusters of up to eight parts, as cut_kernel
// does, but without culling. A warp reads the gaussians of the drawn clusters, a lane
// one gaussian; and marks the pixels that see a body, a lane one pixel.

#include "draw/clipped.h"

#include <algorithm>

#include "base/device_guard.h"
#include "base/launch.cuh"
#include "camera/pixel_slopes.h"
#include "project/sources.cuh"
#include "rasterize/clipped_math.h"
#include "rasterize/sense_math.h"
#include "select/cut_kernel.cuh"
#include "select/place_instances.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kClipBlocks = 2;  // resident blocks per multiprocessor

// A run of gaussians that one warp tests.
struct ClippedRun {
    uint32_t model, first, count;
    uint32_t cluster;  // index of the cluster among the codes
    float weight;      // factor of the opacities
};

// The part of a picture that a warp marks.
struct ClippedPlane {
    uint8_t* clipped;
    PixelSlopes slopes;
    int width, height;
};

__device__ BatchCamera camera_of(const ClippedPictures& pictures, uint32_t b) {
    if (pictures.cameras != nullptr) return pictures.cameras[b];
    return {.camera = pictures.eye[b], .environment = kSeesAll, .is_drawn = 1};
}

__device__ ClippedPlane plane_of(const ClippedPictures& pictures, uint32_t b) {
    const Camera& camera =
        pictures.cameras != nullptr ? pictures.cameras[b].camera : pictures.eye[b];
    return {.clipped = pictures.sensors.of(b).planes.clipped,
            .slopes = PixelSlopes(camera.pinhole()),
            .width = pictures.width,
            .height = pictures.height};
}

// Returns the first pixel of a row or a column whose slope is at least `bound`, or one
// before it. `slope` is that of pixel 0, `step` that of a pixel.
__device__ int pixel_at(double bound, double slope, double step, int size) {
    const double pixel = (bound - slope) / step;
    return static_cast<int>(fmin(fmax(floor(pixel), 0.0), static_cast<double>(size)));
}

// Marks the pixels that see a body. All lanes of the warp must call it.
__device__ void mark_pixels(const ClippedBody& body, const ClippedPlane& plane) {
    const PixelSlopes& slopes = plane.slopes;
    const double x = slopes.x_of(0), y = slopes.y_of(0);
    const double x_step = slopes.x_of(1) - x, y_step = slopes.y_of(1) - y;
    const int left = pixel_at(body.lo[0], x, x_step, plane.width);
    const int right = min(pixel_at(body.hi[0], x, x_step, plane.width) + 2, plane.width);
    const int top = pixel_at(body.lo[1], y, y_step, plane.height);
    const int bottom = min(pixel_at(body.hi[1], y, y_step, plane.height) + 2, plane.height);
    const int columns = max(right - left, 0), count = columns * max(bottom - top, 0);
    for (int i = threadIdx.x % 32; i < count; i += 32) {
        const int column = left + i % columns, row = top + i / columns;
        uint8_t& clipped = plane.clipped[size_t(row) * plane.width + column];
        if (clipped == 0 &&
            meets_body(body, slopes.x_of(column), slopes.y_of(row), slopes.near_depth()))
            clipped = 1;
    }
}

// Returns whether a gaussian may extend beyond the near plane although its mean is
// before it. `sphere` has the mean and the reach of the gaussian, in model space.
__device__ bool may_clip(const float4& sphere, const ModelView<float>& view, float near_depth) {
    constexpr float kMargin = 1.001f;  // for rounding
    const float mean[3] = {sphere.x, sphere.y, sphere.z};
    float p[3];
    to_view(view, mean, p);
    const float* row = view.linear + 6;
    const float reach = kMargin * sphere.w * sqrt_of(dot3(row, row));
    return p[2] < near_depth && !(p[2] + reach < near_depth - (kMargin - 1) * near_depth);
}

__device__ bool body_of_gaussian(const Gaussian3d<float>& g, const ModelView<float>& view,
                                 float weight, float near_depth, ClippedBody& body) {
    float p[3];
    to_view(view, g.mean, p);
    if (!(p[2] < near_depth)) return false;
    const double mean[3] = {p[0], p[1], p[2]};
    double axes[9];
    axes_in_view(g, view, axes);
    return set_clipped_body(mean, axes, double(g.opacity) * weight, near_depth, body);
}

__device__ bool body_of_packed(const PackedPlanes& planes, uint32_t g, const ModelView<float>& view,
                               float weight, float near_depth, ClippedBody& body) {
    const float4 sphere = load4(planes.plane[0], g), a = load4(planes.plane[1], g),
                 b = load4(planes.plane[2], g), c = load4(planes.plane[3], g);
    const float f[8] = {a.x, a.y, a.z, a.w, b.x, b.y, b.z, b.w};
    const float mean_in_model[3] = {sphere.x, sphere.y, sphere.z};
    float p[3], axis[3][3];
    to_view(view, mean_in_model, p);
    const float length = axes_of_factor(f, axis[0], axis[1], axis[2]);
    double axes[9];
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) {
            const float* row = view.linear + 3 * i;
            axes[3 * i + k] = double(length) * dot3(row, axis[k]);
        }
    const double mean[3] = {p[0], p[1], p[2]};
    return set_clipped_body(mean, axes, double(exp2f(c.x)) * weight, near_depth, body);
}

// Sets the clipped body of gaussian g of a run. Returns false if there is none.
__device__ bool body_of(const DrawnModels& models, const ClippedRun& run, uint32_t g,
                        const ModelView<float>& view, float near_depth, ClippedBody& body) {
    if (models.coded != nullptr && CodeSource::has(models.coded[run.model])) {
        const CodedGaussians& coded = models.coded[run.model];
        float color[3];
        const Gaussian3d<float> gaussian =
            CodeSource::decoded(coded, run.cluster, CodeSource::fetch(coded, g), color);
        return body_of_gaussian(gaussian, view, run.weight, near_depth, body);
    }
    const bool has_packed = models.packed != nullptr && PackedSource::has(models.packed[run.model]);
    if (has_packed && !may_clip(PackedSource::fetch(models.packed[run.model], g), view, near_depth))
        return false;
    if (models.rows != nullptr && models.rows[run.model].quats != nullptr)
        return body_of_gaussian(gaussian_in_row(models.rows[run.model], g), view, run.weight,
                                near_depth, body);
    return body_of_packed(models.packed[run.model], g, view, run.weight, near_depth, body);
}

// Marks the pixels that a run clips. All lanes of the warp must call it, with the same
// arguments.
__device__ void clip_run(const DrawnModels& models, const ClippedRun& run,
                         const ModelView<float>& view, const ClippedPlane& plane) {
    __shared__ ClippedBody bodies[kCutWarps];
    ClippedBody& shared = bodies[threadIdx.x / 32];
    const unsigned lane = threadIdx.x % 32;
    const auto near_depth = static_cast<float>(plane.slopes.near_depth());
    for (uint32_t first = 0; first < run.count; first += 32) {
        ClippedBody body;
        const bool is_one = first + lane < run.count &&
                            body_of(models, run, run.first + first + lane, view, near_depth, body);
        for (unsigned lanes = __ballot_sync(kAllLanes, is_one); lanes != 0; lanes &= lanes - 1) {
            if (lane + 1 == static_cast<unsigned>(__ffs(static_cast<int>(lanes)))) shared = body;
            __syncwarp();
            mark_pixels(shared, plane);
            __syncwarp();
        }
    }
}

// Returns whether all means in a box are beyond the near plane.
__device__ bool is_beyond(const Box& box, const ModelView<float>& view, double near_depth) {
    float middle[3], p[3], half = 0.0f;
    for (int k = 0; k < 3; ++k) middle[k] = 0.5f * box.lo[k] + 0.5f * box.hi[k];
    to_view(view, middle, p);
    for (int k = 0; k < 3; ++k)
        half += fabsf(view.linear[6 + k]) * (0.5f * box.hi[k] - 0.5f * box.lo[k]);
    const float margin = 16.0f * FLT_EPSILON * (fabsf(p[2]) + half);
    return p[2] - half - margin > static_cast<float>(near_depth);
}

// The instances of all pictures, and where their places are written.
struct ClippedPlaces {
    PlacedScene scene;
    EnvironmentTable environments;
    uint32_t num_slots;  // of each picture
    Placement* placements;
    int32_t* bundle_of_place;
    float* opacity;
};

// One thread per place.
__global__ void __launch_bounds__(kPlaceThreads, kPlaceBlocks / 2)
    place_clipped_kernel(ClippedPlaces places, ClippedPictures pictures, SelectRule rule,
                         const CutChoice* choice, CutScratch scratch) {
    __shared__ BatchCamera own;
    const PlacedScene& scene = places.scene;
    const size_t block = take_ticket(scratch.place_ticket);
    const unsigned blocks_each = places.num_slots / kPlaceThreads;
    const uint32_t b = static_cast<uint32_t>(block / blocks_each);
    const int32_t s = static_cast<int32_t>(block % blocks_each * kPlaceThreads + threadIdx.x);
    if (threadIdx.x == 0) own = camera_of(pictures, b);
    if (choice != nullptr) rule.tolerance_px2 = choice->tolerance_px2;
    __syncthreads();
    const int32_t num_instances =
        own.is_drawn != 0 ? places.environments.num_slots(own.environment) : 0;
    InstanceSlot slot{.is_taken = s < num_instances,
                      .instance = 0,
                      .place = block * kPlaceThreads + threadIdx.x,
                      .image = b};
    if (slot.is_taken) {
        slot.instance = static_cast<size_t>(places.environments.instance_of(own.environment, s));
        const InstanceTable& instances = scene.instances;
        places.bundle_of_place[slot.place] = instances.bundle[slot.instance];
        places.opacity[slot.place] =
            instances.factors.empty() ? 1.0f : instances.factors[slot.instance].opacity;
    }
    const Eyes eyes(own.camera);
    const auto sides_of = [&](int32_t bundle) {
        return sides_of_eyes(eyes, scene.bundles[bundle].table.pad_px);
    };
    const Placed placed = place_instance(scene, slot, eyes, sides_of, rule, places.placements);
    const unsigned num_parts =
        write_parts(scene, placed, block, slot.place, static_cast<size_t>(num_instances), scratch);
    if (block + 1 == gridDim.x && threadIdx.x == 0) *scratch.num_parts = num_parts;
}

// Marks the pixels that the clusters of the warp's lanes clip. All lanes must call it.
template <bool kFades>
__device__ void clip_clusters(const LaneClusters& mine, const ClippedPlaces& places,
                              const DrawnModels& models, const ClippedPictures& pictures) {
    __shared__ LaneClusters clusters[kCutThreads];
    clusters[threadIdx.x] = mine;
    __syncwarp();
    const bool has_any = mine.bundle != nullptr && mine.drawn != 0;
    for (unsigned lanes = __ballot_sync(kAllLanes, has_any); lanes != 0; lanes &= lanes - 1) {
        const unsigned lane = static_cast<unsigned>(__ffs(static_cast<int>(lanes))) - 1;
        const LaneClusters& lane_clusters = clusters[threadIdx.x / 32 * 32 + lane];
        const ClusterTable& table = lane_clusters.bundle->table;
        const Placement placement = places.placements[lane_clusters.place];
        const ClippedPlane plane = plane_of(pictures, placement.image);
        const float opacity = places.opacity[lane_clusters.place];
        for (unsigned k = 0; k < kLaneClusters; ++k) {
            if ((lane_clusters.drawn >> k & 1) == 0) continue;
            const auto c = static_cast<size_t>(lane_clusters.cluster(k));
            if (is_beyond(table.box[c], placement.view, plane.slopes.near_depth())) continue;
            const float share = kFades ? share_of(lane_clusters.weights[k]) : 1.0f;
            const ClippedRun run{.model = placement.model,
                                 .first = static_cast<uint32_t>(table.first_row(c)),
                                 .count = lane_clusters.size(k),
                                 .cluster = table.place_of(c),
                                 .weight = share * opacity};
            clip_run(models, run, placement.view, plane);
        }
    }
    __syncwarp();
}

// A block marks what the parts of a ticket clip.
template <bool kFades>
__global__ void __launch_bounds__(kCutThreads, kClipBlocks)
    clip_scene_kernel(ClippedPlaces places, DrawnModels models, ClippedPictures pictures,
                      SelectRule rule, const CutChoice* choice, CutScratch scratch) {
    const PlacedScene& scene = places.scene;
    const unsigned num_parts = *scratch.num_parts, at_once = scratch.parts_at_once(num_parts);
    const unsigned num_tickets = blocks_for(num_parts, at_once);
    if (choice != nullptr) rule.tolerance_px2 = choice->tolerance_px2;
    if (!kFades) rule.fade = {};
    for (unsigned ticket = take_ticket(scratch.cut_ticket); ticket < num_tickets;
         ticket = take_ticket(scratch.cut_ticket)) {
        const unsigned warp = threadIdx.x / 32, p = ticket * at_once + warp;
        LaneClusters mine{};
        if (warp < at_once && p < num_parts) mine = clusters_of_lane(scene, scene.parts[p]);
        const auto weigh = [&](const BundleOnDevice& bundle, const InstanceView& view, int32_t c) {
            return cut_by_asking(bundle.table, view, rule).drawn_weight(c);
        };
        ask_clusters<kFades>(scene, rule, Tolerances::this_one, mine, weigh);
        clip_clusters<kFades>(mine, places, models, pictures);
    }
}

// One warp per pair.
__global__ void __launch_bounds__(kCutThreads)
    clip_given_kernel(SceneOnDevice scene, DrawnModels models, ClippedPictures pictures,
                      GivenCut given) {
    const ClippedPlane plane = plane_of(pictures, 0);
    const size_t step = size_t(gridDim.x) * kCutWarps;
    for (size_t s = size_t(blockIdx.x) * kCutWarps + threadIdx.x / 32; s < given.instance.size;
         s += step) {
        const auto i = static_cast<size_t>(given.instance[s]);
        if (!scene.instances.is_drawn(i)) continue;
        const int32_t bundle = scene.instances.bundle[i];
        const ClusterTable& table = scene.bundles[bundle].table;
        const auto c = static_cast<size_t>(given.cluster[s]);
        const Pose pose = scene.instances.pose(i);
        const Placement placement =
            placement_of(axes_of_instance(pictures.eye[0], pose), pose, bundle, 0);
        if (is_beyond(table.box[c], placement.view, plane.slopes.near_depth())) continue;
        const float opacity =
            scene.instances.factors.empty() ? 1.0f : scene.instances.factors[i].opacity;
        const ClippedRun run{.model = placement.model,
                             .first = static_cast<uint32_t>(table.first_row(c)),
                             .count = static_cast<uint32_t>(table.offset[c + 1] - table.offset[c]),
                             .cluster = table.place_of(c),
                             .weight = given.weight_of(s) * opacity};
        clip_run(models, run, placement.view, plane);
    }
}

// One warp per kItemSize gaussians.
__global__ void __launch_bounds__(kCutThreads)
    clip_model_kernel(DrawnModels models, ClippedPictures pictures, ModelView<float> view,
                      size_t count) {
    const ClippedPlane plane = plane_of(pictures, 0);
    const size_t step = size_t(gridDim.x) * kCutWarps * kItemSize;
    for (size_t first = (size_t(blockIdx.x) * kCutWarps + threadIdx.x / 32) * kItemSize;
         first < count; first += step) {
        const size_t size = min(count - first, static_cast<size_t>(kItemSize));
        clip_run(models,
                 {.model = 0,
                  .first = static_cast<uint32_t>(first),
                  .count = static_cast<uint32_t>(size),
                  .cluster = 0,
                  .weight = 1.0f},
                 view, plane);
    }
}

void clear(const ClippedPictures& pictures, cudaStream_t stream) {
    const size_t num_pixels = size_t(pictures.width) * pictures.height;
    const bool are_adjacent = pictures.sensors.num_pixels > 0;
    const uint32_t num_planes = are_adjacent ? 1 : pictures.count;
    const size_t num_bytes = are_adjacent ? pictures.count * num_pixels : num_pixels;
    for (uint32_t b = 0; b < num_planes; ++b)
        check(cudaMemsetAsync(pictures.sensors.of(b).planes.clipped, 0, num_bytes, stream),
              "cudaMemsetAsync");
}

unsigned blocks_of(size_t num_warps) {
    const unsigned most = kClipBlocks * num_multiprocessors();
    return static_cast<unsigned>(
        std::clamp<size_t>(blocks_for(num_warps, kCutWarps), 1, size_t(most)));
}

}  // namespace

void ClippedPass::mark_scene(const SceneTables& scene, const SeenBounds& seen,
                             const ClippedPictures& pictures, const DrawnModels& models,
                             SelectRule rule, const CutChoice* choice, cudaStream_t stream,
                             const PartlyResident* resident) {
    const DeviceGuard guard(device_);
    const StreamLock lock = scene.lock(stream);
    clear(pictures, stream);
    rule.culls = false;
    rule.budget = kNoBudget;
    const size_t num_slots = batch_slots(seen.instances), count = pictures.count * num_slots;
    const size_t parts = std::max<size_t>(pictures.count * seen.parts, 1);
    const unsigned num_places = kCutBlocks * num_multiprocessors();
    const size_t num_tickets = std::max<size_t>(blocks_for(parts, kCutWarps), num_places);
    const size_t num_zeros = zeros_of_round(count);
    Count* zeros = zeros_.reserve(num_zeros, stream);
    check(cudaMemsetAsync(zeros, 0, num_zeros * sizeof(Count), stream), "cudaMemsetAsync");
    const CutScratch scratch =
        scratch_in(zeros, states_.reserve(2 * num_tickets, stream), num_tickets, num_places);
    const SceneOnDevice on_device = scene.on_device();
    int32_t* bundle_of_place = bundle_of_place_.reserve(count, stream);
    const ClippedPlaces places{
        .scene = {.bundles = resident == nullptr ? on_device.bundles : resident->bundles,
                  .instances = on_device.instances,
                  .bundle_of_place = bundle_of_place,
                  .views = views_.reserve(count, stream),
                  .tops = tops_.reserve(count, stream),
                  .parts = parts_.reserve(parts, stream)},
        .environments = on_device.environments,
        .num_slots = static_cast<uint32_t>(num_slots),
        .placements = placements_.reserve(count, stream),
        .bundle_of_place = bundle_of_place,
        .opacity = opacity_.reserve(count, stream)};
    launch("place_clipped_kernel", place_clipped_kernel, blocks_for(count, kPlaceThreads),
           kPlaceThreads, 0, stream, places, pictures, rule, choice, scratch);
    const auto kernel = rule.fade.is_on() ? clip_scene_kernel<true> : clip_scene_kernel<false>;
    launch("clip_scene_kernel", kernel, blocks_of(parts), kCutThreads, 0, stream, places, models,
           pictures, rule, choice, scratch);
}

void ClippedPass::mark_given(const SceneTables& scene, const ClippedPictures& pictures,
                             const DrawnModels& models, const GivenCut& given,
                             cudaStream_t stream) const {
    const DeviceGuard guard(device_);
    const StreamLock lock = scene.lock(stream);
    clear(pictures, stream);
    launch("clip_given_kernel", clip_given_kernel, blocks_of(given.instance.size), kCutThreads, 0,
           stream, scene.on_device(), models, pictures, given);
}

void ClippedPass::mark_model(const ClippedPictures& pictures, const DrawnModels& models,
                             const ModelView<float>& view, size_t count, cudaStream_t stream) {
    clear(pictures, stream);
    launch("clip_model_kernel", clip_model_kernel, blocks_of(blocks_for(count, kItemSize)),
           kCutThreads, 0, stream, models, pictures, view, count);
}

size_t ClippedPass::bytes() const {
    return views_.bytes() + tops_.bytes() + bundle_of_place_.bytes() + opacity_.bytes() +
           placements_.bytes() + parts_.bytes() + zeros_.bytes() + states_.bytes();
}

}  // namespace cuda
}  // namespace v3dg
