// Draws several views of the same gaussians, with a backward pass. Idle frames are kept
// for reuse.

#include "draw/views_frame_cuda.h"

#include <algorithm>
#include <map>
#include <mutex>
#include <stdexcept>
#include <string>

#include "base/launch.cuh"
#include "rasterize/rasterize.h"

namespace v3dg {
namespace cuda {

namespace {

// Limits of a frame, which bound its memory.
constexpr size_t kMostPixels = size_t(1) << 23;
constexpr size_t kMostRecords = size_t(1) << 25;

constexpr unsigned kItemThreads = 128;

// The items of all views; each view has `num_items` of them.
struct ViewItems {
    unsigned long long num_gaussians;
    uint32_t num_views, num_items;
    Appearance<float> appearance;
};

// Launched with one thread per item.
__global__ void view_items_kernel(ViewItems views, ItemList items) {
    const unsigned long long i =
        blockIdx.x * static_cast<unsigned long long>(blockDim.x) + threadIdx.x;
    const unsigned long long num_items =
        static_cast<unsigned long long>(views.num_views) * views.num_items;
    if (i == 0) {
        items.counters->items = num_items;
        items.counters->gaussians = num_items * kItemSize;
    }
    if (i >= num_items || !items.has_room_for(num_items, num_items * kItemSize)) return;
    const uint32_t view = static_cast<uint32_t>(i / views.num_items);
    const uint32_t first = static_cast<uint32_t>(i % views.num_items) * kItemSize;
    const uint32_t size = static_cast<uint32_t>(
        min(static_cast<unsigned long long>(kItemSize), views.num_gaussians - first));
    const uint32_t record = static_cast<uint32_t>(i) * kItemSize;
    items.items[i] = {view, first, size, record, views.appearance, 0, 0, 1.0f};
}

}  // namespace

size_t most_views(size_t num_gaussians, size_t num_pixels) {
    const size_t padded = size_t(kItemSize) * blocks_for(num_gaussians, kItemSize);
    const size_t most = std::min(kMostPixels / std::max<size_t>(num_pixels, 1),
                                 kMostRecords / std::max<size_t>(padded, 1));
    return std::max<size_t>(most, 1);
}

ViewsFrame::ViewsFrame() {
    check(cudaGetDevice(&device_), "cudaGetDevice");
    for (cudaEvent_t* event : {&drawn_, &gone_back_})
        check(cudaEventCreateWithFlags(event, cudaEventDisableTiming), "cudaEventCreate");
}

ViewsFrame::~ViewsFrame() {
    for (const cudaEvent_t event : {drawn_, gone_back_})
        if (event != nullptr) cudaEventDestroy(event);
    // Ignore errors, because at exit the driver may be unloaded before this object is
    // destroyed.
    cudaGetLastError();
}

void ViewsFrame::draw(const ViewsInput& in, cudaStream_t stream) {
    in_ = in;
    // Another stream may still read the tables.
    for (const cudaEvent_t event : {drawn_, gone_back_})
        check(cudaStreamWaitEvent(stream, event, 0), "cudaStreamWaitEvent");
    const auto num_views = static_cast<uint32_t>(in.views.size());
    const bool has_model_for_each_view = in.models.size() > 1;
    std::vector<Placement> placements;
    for (uint32_t view = 0; view < num_views; ++view)
        placements.push_back({in.views[view], has_model_for_each_view ? view : 0, view});
    models_.copy_from({in.models.data(), in.models.size()}, stream);
    placements_.copy_from({placements.data(), placements.size()}, stream);
    images_.copy_from({in.images.data(), in.images.size()}, stream);

    const size_t num_gaussians = in.models[0].size;
    const ViewItems items_of_views{.num_gaussians = num_gaussians,
                                   .num_views = num_views,
                                   .num_items = blocks_for(num_gaussians, kItemSize),
                                   .appearance = {in.filter_px2, in.antialiased, false}};
    const unsigned blocks =
        std::max(1u, blocks_for(size_t(num_views) * items_of_views.num_items, kItemThreads));
    const FrameBatch batch{.models = models_.data(),
                           .placements = placements_.data(),
                           .images = images_.data(),
                           .num_images = num_views,
                           .num_tiles = num_views * num_tiles_of(in.images[0]),
                           .has_depth = in.images[0].planes.depth != nullptr};
    const std::unique_ptr<Drawing> drawing = frame_.draw(
        batch,
        [items_of_views, blocks](const ItemList& items, cudaStream_t on) {
            launch("view_items_kernel", view_items_kernel, blocks, kItemThreads, 0, on,
                   items_of_views, items);
        },
        stream);
    num_slots_ = drawing->settle().slots;
    if (num_slots_ > UINT32_MAX)
        throw std::length_error("gaussians: expected at most 4294967295 gradient slots, got " +
                                std::to_string(num_slots_));
    check(cudaEventRecord(drawn_, stream), "cudaEventRecord");
}

void ViewsFrame::backward(const std::vector<PictureGradient<float>>& d_pictures,
                          const ViewsGradients& out, bool adds, float* d_background,
                          cudaStream_t stream) {
    check(cudaStreamWaitEvent(stream, drawn_, 0), "cudaStreamWaitEvent");
    const FrameTape tape = frame_.tape();
    const DeviceBuffer<RecordGradient<float>> slot(num_slots_, stream);
    const DeviceBuffer<CenterSize<float>> size(out.centers.size != nullptr ? num_slots_ : 0,
                                               stream);
    const DeviceBuffer<uint8_t> is_touched(num_slots_, stream);
    const DeviceBuffer<float> d_background_of_tile(3 * size_t(tape.lists.num_tiles), stream);
    if (num_slots_ > 0)
        check(cudaMemsetAsync(is_touched.data(), 0, num_slots_, stream), "cudaMemsetAsync");
    const GradientSlots slots{tape.first_slot, slot.data(),
                              out.centers.size != nullptr ? size.data() : nullptr,
                              is_touched.data()};
    const DeviceBuffer<PictureGradient<float>> of_pictures(
        Span<const PictureGradient<float>>{d_pictures.data(), d_pictures.size()}, stream);
    const auto num_views = static_cast<uint32_t>(in_.views.size());
    rasterize_backward({.image = {},
                        .records = tape.lists.records,
                        .tile_first = tape.lists.tile_first,
                        .order = tape.raster.order,
                        .blended = tape.raster.blended,
                        .plans = tape.lists.plans,
                        .d_picture = {}},
                       {.images = images_.data(),
                        .d_pictures = of_pictures.data(),
                        .num_tiles = tape.lists.num_tiles,
                        .has_depth = d_pictures[0].depth != nullptr,
                        .num_images = num_views},
                       slots, d_background_of_tile.data(), d_background, stream);
    project_views_backward({.item_records = tape.item_records,
                            .records = tape.lists.records,
                            .source = tape.source,
                            .models = models_.data(),
                            .has_model_for_each_view = in_.models.size() > 1,
                            .num_gaussians = in_.models[0].size,
                            .sh_degree = in_.models[0].sh_degree,
                            .placements = placements_.data(),
                            .images = images_.data(),
                            .num_views = num_views,
                            .filter_px2 = in_.filter_px2,
                            .antialiased = in_.antialiased},
                           slots, out, adds, stream);
    check(cudaEventRecord(gone_back_, stream), "cudaEventRecord");
}

namespace {

struct IdleViewsFrames {
    std::mutex mutex;
    std::map<int, std::vector<std::unique_ptr<ViewsFrame>>> of_device;
};

IdleViewsFrames& idle_views_frames() {
    // This object is never destroyed, because at exit the driver may be unloaded before
    // static objects are destroyed.
    static IdleViewsFrames& frames = *new IdleViewsFrames;
    return frames;
}

}  // namespace

std::unique_ptr<ViewsFrame> take_views_frame() {
    int device;
    check(cudaGetDevice(&device), "cudaGetDevice");
    IdleViewsFrames& idle = idle_views_frames();
    const std::lock_guard<std::mutex> lock(idle.mutex);
    auto& frames = idle.of_device[device];
    if (frames.empty()) return std::make_unique<ViewsFrame>();
    auto frame = std::move(frames.back());
    frames.pop_back();
    return frame;
}

void give_back(std::unique_ptr<ViewsFrame> frame) {
    IdleViewsFrames& idle = idle_views_frames();
    const std::lock_guard<std::mutex> lock(idle.mutex);
    idle.of_device[frame->device_].push_back(std::move(frame));
}

}  // namespace cuda
}  // namespace v3dg
