// Implements cast_scene_cuda.h: it divides a cast into parts, owns the buffers, and
// casts a part again if a buffer was too small.

#include "draw/cast_scene_cuda.h"

#include <algorithm>
#include <stdexcept>

#include "base/launch.cuh"
#include "select/read_cameras.cuh"

namespace v3dg {
namespace cuda {

namespace {

// Limits of a part, which bound its memory; a record has 128 bytes. With at most
// kMostTiles tiles, entries have at least 15 bits for distances.
constexpr size_t kMostGaussians = size_t(1) << 23;
constexpr size_t kMostTiles = size_t(1) << 16;
constexpr uint32_t kMostPoses = 256;
// Indices of entries have 32 bits.
constexpr unsigned long long kMostEntries = (1ull << 32) - 2;

constexpr unsigned kItemThreads = 128;

// Writes the items of an asset and its placements. Launched with one thread per item of
// each pose.
__global__ void asset_items_kernel(BatchViews views, uint32_t num_gaussians, uint32_t items_each,
                                   Appearance<float> appearance, Placement* placements,
                                   ItemList items) {
    const uint32_t i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i == 0) {
        items.counters->items = static_cast<unsigned long long>(items_each) * views.num_cameras;
        items.counters->gaussians =
            static_cast<unsigned long long>(num_gaussians) * views.num_cameras;
    }
    if (i >= items_each * views.num_cameras || i >= items.item_capacity) return;
    const uint32_t pose = i / items_each, first = i % items_each * kItemSize;
    const BatchCamera camera = read_camera(views.arrays, {}, views.first_camera + pose);
    if (first == 0) {
        placements[pose] = {view_of_world<float>(camera.camera), 0, pose};
        views.counts[pose] = {};
    }
    const uint32_t count = min(static_cast<uint32_t>(kItemSize), num_gaussians - first);
    items.items[i] = {.placement = pose,
                      .first = first,
                      .count = camera.is_drawn != 0 ? count : 0,
                      .record = pose * num_gaussians + first,
                      .appearance = appearance,
                      .sharers = 0,
                      .cluster = 0,
                      .weight = 1};
}

// Returns the mean angle between neighbours, or a large one if there is only one angle.
float step_of(const AngleTable& table) {
    if (table.size < 2) return kTurn;
    return (table.angles[table.size - 1] - table.angles[0]) / static_cast<float>(table.size - 1);
}

// Sets the tiles of a warp: 8 x 4 rays, or 16 x 2 if the former are higher than wide.
void set_tile_size(const RayGrid& grid, RayDirections& rays) {
    const RayDirections& on_host = grid.directions();
    const bool is_high = 4 * step_of(on_host.elevation) > 8 * step_of(on_host.azimuth);
    rays.tile_width = is_high ? 16 : 8;
    rays.tile_height = kRaysOfTile / rays.tile_width;
}

}  // namespace

const RayDirections& DeviceRayGrid::load(const std::shared_ptr<const RayGrid>& grid,
                                         cudaStream_t stream) {
    if (grid_ == grid) return directions_;
    std::vector<float> floats;
    std::vector<int32_t> ints;
    for (const RayGrid::Angles* from : {&grid->azimuth(), &grid->elevation()}) {
        for (const std::vector<float>* values : {&from->angles, &from->cosine, &from->sine})
            floats.insert(floats.end(), values->begin(), values->end());
        for (const std::vector<int32_t>* values : {&from->first_in_bucket, &from->place})
            ints.insert(ints.end(), values->begin(), values->end());
    }
    const float* next_floats = floats_.copy_from({floats.data(), floats.size()}, stream);
    const int32_t* next_ints = ints_.copy_from({ints.data(), ints.size()}, stream);
    const auto take_floats = [&](const std::vector<float>& values) {
        return std::exchange(next_floats, next_floats + values.size());
    };
    const auto take_ints = [&](const std::vector<int32_t>& values) {
        return std::exchange(next_ints, next_ints + values.size());
    };
    directions_ = grid->directions();
    const RayGrid::Angles& azimuth = grid->azimuth();
    directions_.azimuth.angles = take_floats(azimuth.angles);
    directions_.azimuth_cosine = take_floats(azimuth.cosine);
    directions_.azimuth_sine = take_floats(azimuth.sine);
    directions_.azimuth.first_in_bucket = take_ints(azimuth.first_in_bucket);
    directions_.column_place = take_ints(azimuth.place);
    const RayGrid::Angles& elevation = grid->elevation();
    directions_.elevation.angles = take_floats(elevation.angles);
    directions_.elevation_cosine = take_floats(elevation.cosine);
    directions_.elevation_sine = take_floats(elevation.sine);
    directions_.elevation.first_in_bucket = take_ints(elevation.first_in_bucket);
    directions_.row_place = take_ints(elevation.place);
    set_tile_size(*grid, directions_);
    grid_ = grid;
    return directions_;
}

// What is cast: a scene and its rule, or an asset.
struct RayFrame::Subject {
    const SceneTables* scene;
    SelectRule rule;
    GaussianRows<const float> rows;
    Appearance<float> appearance;
};

// The counters of a part on the device. The zeros of items follow them in memory, then
// the counts of the images.
struct RayFrame::Counts {
    FrameCounters items;
    RayListCounts lists;
};

void RayFrame::set_models(std::vector<DeviceModel> models, cudaStream_t stream) {
    std::vector<GaussianRows<const float>> rows(models.size());
    std::vector<CodedGaussians> coded(models.size());
    has_rows_ = false;
    has_coded_ = false;
    for (size_t b = 0; b < models.size(); ++b) {
        if (models[b].coded != nullptr) {
            coded[b] = {models[b].coded->codes(), {}};
            has_coded_ = true;
        } else {
            rows[b] = models[b].packed->rows();
            has_rows_ = true;
        }
    }
    const StreamLock lock(busy_, stream);
    rows_.copy_from({rows.data(), rows.size()}, stream);
    coded_.copy_from({coded.data(), coded.size()}, stream);
    models_ = std::move(models);
}

std::vector<int64_t> RayFrame::cast_scene(const SceneTables& scene, const RaySensor& sensor,
                                          const RayPoses& poses, SelectRule rule,
                                          const RayPlanes& planes, cudaStream_t stream) {
    rule.culls = false;
    return cast({.scene = &scene, .rule = rule, .rows = {}, .appearance = {}}, sensor, poses,
                planes, stream);
}

std::vector<int64_t> RayFrame::cast_model(const GaussianRows<const float>& rows,
                                          const Appearance<float>& appearance,
                                          const RaySensor& sensor, const RayPoses& poses,
                                          const RayPlanes& planes, cudaStream_t stream) {
    return cast({.scene = nullptr, .rule = {}, .rows = rows, .appearance = appearance}, sensor,
                poses, planes, stream);
}

std::vector<int64_t> RayFrame::cast(const Subject& subject, const RaySensor& sensor,
                                    const RayPoses& poses, const RayPlanes& planes,
                                    cudaStream_t stream) {
    refuse_capture(stream);
    const StreamLock lock(busy_, stream);
    const size_t num_tiles = grid_.load(sensor.grid, stream).num_tiles();
    if (num_tiles > kMostRayTiles)
        throw std::length_error("rays: expected at most 8589934560 on a CUDA device, got more");
    const double focal = 1.0 / sensor.limits.spacing;
    const double K[9] = {focal, 0, 0, 0, focal, 0, 0, 0, 1};
    const CameraArrays arrays{.viewmats = poses.viewmats,
                              .intrinsics = intrinsics_.copy_from({K, 9}, stream),
                              .environments = poses.environments,
                              .are_viewmats_double = poses.are_double,
                              .are_intrinsics_double = true,
                              .shares_intrinsics = true,
                              .are_environments_long = poses.are_environments_long,
                              .width = 1,
                              .height = 1,
                              .near_depth = sensor.limits.nearest};
    std::vector<int64_t> gaussians;
    const size_t num_rays = sensor.grid->directions().num_rays();
    for (uint32_t first = 0; first < poses.count;) {
        const auto of_tiles = static_cast<uint32_t>(std::max<size_t>(kMostTiles / num_tiles, 1));
        const uint32_t count = std::min({most_poses_, of_tiles, poses.count - first});
        try {
            const std::vector<int64_t> part = cast_part(subject, sensor, arrays, first, count,
                                                        planes.from(first * num_rays), stream);
            gaussians.insert(gaussians.end(), part.begin(), part.end());
            first += count;
        } catch (const OutOfMemory&) {
            if (count == 1) throw;
            release_buffers();
            most_poses_ = count / 2;
        }
    }
    return gaussians;
}

RayInput RayFrame::write_items(const Subject& subject, const BatchViews& views,
                               const ItemList& items, cudaStream_t stream) {
    RayInput input{.rows = has_rows_ ? rows_.data() : nullptr,
                   .coded = has_coded_ ? coded_.data() : nullptr,
                   .placements = placements_.reserve(views.num_places(), stream),
                   .items = items,
                   .factors = nullptr,
                   .num_factors = static_cast<uint32_t>(views.num_places()),
                   .image_counts = views.counts};
    if (subject.scene == nullptr) {
        const auto num_gaussians = static_cast<uint32_t>(subject.rows.size);
        input.rows = asset_.copy_from({&subject.rows, 1}, stream);
        input.coded = nullptr;
        const uint32_t items_each = blocks_for(num_gaussians, kItemSize);
        const unsigned blocks =
            std::max(blocks_for(size_t(items_each) * views.num_cameras, kItemThreads), 1u);
        launch("asset_items_kernel", asset_items_kernel, blocks, kItemThreads, 0, stream, views,
               num_gaussians, items_each, subject.appearance, placements_.data(), items);
        return input;
    }
    const bool has_factors = !subject.scene->on_device().instances.factors.empty();
    if (has_factors) input.factors = factors_.reserve(views.num_places(), stream);
    const BatchPlacements out{.images = images_.reserve(views.num_cameras, stream),
                              .placements = placements_.data(),
                              .factors = has_factors ? factors_.data() : nullptr};
    cut_.cut_batch(*subject.scene, views, subject.rule, out, items, stream);
    return input;
}

RayLists RayFrame::project(const Subject& subject, const RaySensor& sensor, const BatchViews& views,
                           const RayDirections& rays, unsigned char* cleared, cudaStream_t stream) {
    auto* counts = reinterpret_cast<Counts*>(cleared);
    const ItemList items{.items = items_.reserve(item_capacity_, stream),
                         .counters = &counts->items,
                         .item_capacity = item_capacity_,
                         .record_capacity = kMostRayGaussians,
                         .zeros = reinterpret_cast<unsigned long long*>(cleared + sizeof(Counts))};
    const RayInput input = write_items(subject, views, items, stream);
    const RayLists lists{.records = records_.reserve(record_capacity_, stream),
                         .entries = entries_.reserve(entry_capacity_, stream),
                         .counts = &counts->lists,
                         .record_capacity = record_capacity_,
                         .entry_capacity = entry_capacity_,
                         .distance_bits = distance_bits_of(views.num_cameras * rays.num_tiles())};
    project_to_rays(input, rays, sensor.limits, lists, stream);
    return lists;
}

std::vector<int64_t> RayFrame::cast_part(const Subject& subject, const RaySensor& sensor,
                                         const CameraArrays& poses, uint32_t first, uint32_t count,
                                         const RayPlanes& planes, cudaStream_t stream) {
    const RayDirections& rays = grid_.load(sensor.grid, stream);
    const bool is_scene = subject.scene != nullptr;
    SeenBounds seen{1, 1};
    if (is_scene)
        seen = poses.environments == nullptr ? subject.scene->seen_by_all()
                                             : subject.scene->seen_in_environment();
    const size_t num_slots = is_scene ? batch_slots(seen.instances) : 1;
    const size_t num_zeros = Cut::num_batch_zeros(num_slots * count);
    const size_t num_before = sizeof(Counts) + num_zeros * sizeof(unsigned long long);
    const size_t num_cleared = num_before + count * sizeof(ImageCounts);
    unsigned char* cleared = counters_.reserve(num_cleared, stream);
    auto* image_counts = reinterpret_cast<ImageCounts*>(cleared + num_before);
    const BatchViews views{.arrays = poses,
                           .first_camera = first,
                           .num_cameras = count,
                           .source = CameraSource::arrays,
                           .cameras = cameras_.reserve(count, stream),
                           .num_slots = static_cast<uint32_t>(num_slots),
                           .most_parts = seen.parts,
                           .first = {},
                           .planes = {},
                           .counts = image_counts};
    std::vector<ImageCounts> counts_of_images(count);
    Counts counts{};
    RayLists lists{};
    for (bool is_complete = false; !is_complete;) {
        check(cudaMemsetAsync(cleared, 0, num_cleared, stream), "cudaMemsetAsync");
        lists = project(subject, sensor, views, rays, cleared, stream);
        check(cudaMemcpyAsync(counts_of_images.data(), image_counts, count * sizeof(ImageCounts),
                              cudaMemcpyDeviceToHost, stream),
              "cudaMemcpyAsync to the host");
        check(cudaMemcpyAsync(&counts, cleared, sizeof counts, cudaMemcpyDeviceToHost, stream),
              "cudaMemcpyAsync to the host");
        check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
        if (counts.items.gaussians > kMostRayGaussians || counts.lists.entries() > kMostEntries)
            throw std::length_error(
                "gaussians: expected at most 268435455 on rays of a CUDA device, got more");
        const auto fits = [](size_t& capacity, unsigned long long number) {
            if (number <= capacity) return true;
            capacity = number + number / 8;
            return false;
        };
        is_complete = fits(item_capacity_, counts.items.items);
        is_complete = fits(record_capacity_, counts.lists.records()) && is_complete;
        is_complete = fits(entry_capacity_, counts.lists.entries()) && is_complete;
    }
    const size_t num_tiles = count * rays.num_tiles();
    sort_entries(lists, counts.lists.entries(), num_tiles, sorted_, stream);
    cast_rays(lists, sorted_, count, rays, sensor.limits, planes, stream);
    const size_t gaussians_each = std::max<size_t>(counts.items.gaussians / count, 1);
    most_poses_ =
        static_cast<uint32_t>(std::clamp<size_t>(kMostGaussians / gaussians_each, 1, kMostPoses));
    std::vector<int64_t> gaussians;
    for (const ImageCounts& of_image : counts_of_images)
        gaussians.push_back(static_cast<int64_t>(of_image.gaussians));
    return gaussians;
}

void RayFrame::release_buffers() {
    records_ = {};
    entries_ = {};
    sorted_ = {};
}

}  // namespace cuda
}  // namespace v3dg
