// Draws target pictures. A frame has thousands of them, larger than needed; they are
// then averaged.

#include "levels/fit_targets_cuda.h"

#include <vector>

#include "base/launch.cuh"

namespace v3dg {
namespace cuda {

namespace {

// Limits of pixels and gaussians in one frame. A frame with a single picture may exceed
// them.
constexpr uint64_t kPixelsAtOnce = uint64_t(1) << 24, kGaussiansAtOnce = uint64_t(1) << 22;
constexpr unsigned kThreads = 128;

// A picture in a frame, and the indices of its first item, record and tile.
struct TargetPicture {
    uint32_t job;
    uint32_t first_item, first_record, first_tile;
    uint64_t picture;      // index among the pictures of the job
    uint64_t first_pixel;  // index of its first pixel in the enlarged pictures
};

__global__ void views_kernel(FitConfig config, Span<const FitJob> jobs, uint64_t pictures,
                             FitView* views) {
    const uint64_t i = blockIdx.x * uint64_t(blockDim.x) + threadIdx.x;
    if (i >= jobs.size * pictures) return;
    const FitJob& job = jobs[i / pictures];
    views[job.first_view + i % pictures] =
        view_of_index(config, job.group, view_of_picture(config, i % pictures));
}

struct TargetTables {
    FitConfig config;
    const FitJob* jobs;
    const FitView* views;
    const TargetPicture* pictures;
    Appearance<float> appearance;
    float *color, *alpha;
    FrameImage* images;
    Placement* placements;
};

// Launched with one block per picture and one thread per item.
__global__ void pictures_kernel(TargetTables t, unsigned long long num_items,
                                unsigned long long num_records, ItemList items) {
    if (blockIdx.x == 0 && threadIdx.x == 0) {
        items.counters->items = num_items;
        items.counters->gaussians = num_records;
    }
    const TargetPicture& p = t.pictures[blockIdx.x];
    const FitJob& job = t.jobs[p.job];
    if (threadIdx.x == 0) {
        const FitView view = t.views[job.first_view + p.picture];
        const int size = t.config.supersample * view.size;
        FrameImage image{};
        image.camera = intrinsics_of(camera_of(view, static_cast<float>(t.config.supersample)));
        image.width = image.height = size;
        image.tile_columns = (size + kFrameTileWidth - 1) / kFrameTileWidth;
        image.tile_rows = (size + kFrameTileHeight - 1) / kFrameTileHeight;
        image.first_tile = p.first_tile;
        image.planes.color = t.color + 3 * p.first_pixel;
        image.planes.alpha = t.alpha + p.first_pixel;
        t.images[blockIdx.x] = image;
        t.placements[blockIdx.x] = {
            view_of_world(t.config, job.group.center, job.group.radius, view), 0, blockIdx.x};
    }
    if (!items.has_room_for(num_items, num_records)) return;
    const uint32_t count = static_cast<uint32_t>(job.group.target_count);
    for (uint32_t i = threadIdx.x; i * kItemSize < count; i += blockDim.x) {
        const uint32_t first = i * kItemSize;
        items.items[p.first_item + i] = {
            .placement = blockIdx.x,
            .first = static_cast<uint32_t>(job.group.target_first) + first,
            .count = min(static_cast<uint32_t>(kItemSize), count - first),
            .record = p.first_record + first,
            .appearance = t.appearance,
            .sharers = 0,
            .cluster = 0,
            .weight = 1.0f};
    }
}

// Averages the enlarged pictures. Launched with one block per picture and one thread
// per target pixel.
__global__ void average_kernel(TargetTables t, float4* targets) {
    const TargetPicture& p = t.pictures[blockIdx.x];
    const FitJob& job = t.jobs[p.job];
    const int scale = t.config.supersample, size = job.size;
    const float share = 1.0f / static_cast<float>(scale * scale);
    float4* out = targets + job.first_pixel + p.picture * size * size;
    for (int i = threadIdx.x; i < size * size; i += blockDim.x) {
        float4 sum = make_float4(0, 0, 0, 0);
        for (int y = 0; y < scale; ++y) {
            const uint64_t first =
                p.first_pixel +
                (static_cast<uint64_t>(i / size * scale + y) * size + i % size) * scale;
            for (int x = 0; x < scale; ++x) {
                sum.x += share * t.color[3 * (first + x)];
                sum.y += share * t.color[3 * (first + x) + 1];
                sum.z += share * t.color[3 * (first + x) + 2];
                sum.w += share * t.alpha[first + x];
            }
        }
        out[i] = sum;
    }
}

unsigned grid_of(uint64_t count) {
    return static_cast<unsigned>((count + kThreads - 1) / kThreads);
}

}  // namespace

void make_views(const FitConfig& config, Span<const FitJob> jobs, FitView* views,
                cudaStream_t stream) {
    const uint64_t pictures = num_pictures(config);
    launch("views_kernel", views_kernel, grid_of(jobs.size * pictures), kThreads, 0, stream, config,
           jobs, pictures, views);
}

void draw_targets(const FitConfig& config, Span<const FitJob> jobs, const FitJob* jobs_on_device,
                  const DeviceFitTarget& target, const FitView* views, float4* targets,
                  Frame& frame, cudaStream_t stream) {
    const uint64_t pictures_of_job = num_pictures(config);
    const DeviceBuffer<GaussianRows<const float>> model(
        Span<const GaussianRows<const float>>{&target.rows, 1}, stream);
    DeviceBuffer<TargetPicture> pictures_on_device;
    DeviceBuffer<float> color, alpha;
    DeviceBuffer<FrameImage> images;
    DeviceBuffer<Placement> placements;
    std::vector<TargetPicture> pictures;
    const uint64_t num = jobs.size * pictures_of_job;
    for (uint64_t next = 0; next < num;) {
        pictures.clear();
        uint64_t pixels = 0, gaussians = 0, items = 0, tiles = 0;
        for (; next < num; ++next) {
            const FitJob& job = jobs[next / pictures_of_job];
            const uint64_t size = static_cast<uint64_t>(job.size) * config.supersample;
            const uint64_t count = job.group.target_count;
            if (!pictures.empty() &&
                (pixels + size * size > kPixelsAtOnce || gaussians + count > kGaussiansAtOnce))
                break;
            pictures.push_back({.job = static_cast<uint32_t>(next / pictures_of_job),
                                .first_item = static_cast<uint32_t>(items),
                                .first_record = static_cast<uint32_t>(gaussians),
                                .first_tile = static_cast<uint32_t>(tiles),
                                .picture = next % pictures_of_job,
                                .first_pixel = pixels});
            pixels += size * size;
            gaussians += count;
            items += (count + kItemSize - 1) / kItemSize;
            tiles += ((size + kFrameTileWidth - 1) / kFrameTileWidth) *
                     ((size + kFrameTileHeight - 1) / kFrameTileHeight);
        }
        const uint32_t num_images = static_cast<uint32_t>(pictures.size());
        TargetTables tables{
            .config = config,
            .jobs = jobs_on_device,
            .views = views,
            .pictures = pictures_on_device.copy_from({pictures.data(), pictures.size()}, stream),
            .appearance = {target.filter_px2, target.antialiased, false},
            .color = color.reserve(3 * pixels, stream),
            .alpha = alpha.reserve(pixels, stream),
            .images = images.reserve(num_images, stream),
            .placements = placements.reserve(num_images, stream)};
        const FrameBatch batch{.models = model.data(),
                               .placements = tables.placements,
                               .images = tables.images,
                               .num_images = num_images,
                               .num_tiles = static_cast<uint32_t>(tiles),
                               .has_depth = false};
        frame
            .draw(
                batch,
                [=](const ItemList& list, cudaStream_t on) {
                    launch("pictures_kernel", pictures_kernel, num_images, kThreads, 0, on, tables,
                           items, gaussians, list);
                },
                stream)
            ->finish();
        launch("average_kernel", average_kernel, num_images, kThreads, 0, stream, tables, targets);
    }
}

}  // namespace cuda
}  // namespace v3dg
