// Refinement on CUDA. Steps are enqueued one after another on the caller's stream. All
// windows of a step are drawn as one frame, with one backward pass. Other threads, each
// with its own stream, work some steps ahead: they plan the windows, compute the cuts,
// and draw the target pictures.

#include "levels/refine_cuts_cuda.h"

#include <algorithm>
#include <memory>

#include "base/ahead.h"
#include "base/device_guard.h"
#include "base/event.h"
#include "base/launch.cuh"
#include "base/own_stream.h"
#include "draw/scene_frame_cuda.h"
#include "levels/cut_windows_cuda.h"
#include "levels/refine_kernels.cuh"
#include "project/project_backward.h"
#include "rasterize/rasterize.h"

namespace v3dg {
namespace cuda {

namespace {

// Number of steps that each thread plans ahead.
constexpr unsigned kStepsAhead = 3;
// A slot's target may be overwritten while the steps before it are drawn.
static_assert(kViewSlots >= (kStepsAhead + 1) * kMostWindows,
              "no step that is being drawn may read it");
constexpr unsigned kMostPlanners = 4;

// Returns the number of threads that plan steps. It satisfies two conditions. First,
// all windows of a slot belong to one thread, which owns the memory of the slot's
// target. Second, a target is never overwritten while it is needed by a step that is
// being drawn.
constexpr unsigned num_planners(unsigned windows_per_step) {
    unsigned num = kMostPlanners;
    while (num > 1 && (kViewSlots % (num * windows_per_step) != 0 ||
                       kViewSlots < kStepsAhead * num * windows_per_step))
        num /= 2;
    return num;
}

// Number of pixels in the largest window.
constexpr size_t kMostPixels = kWidestWindowPx * kWidestWindowPx;

FrameImage image_of(const Camera& camera, const PicturePlanes& planes) {
    const float black[3] = {};
    return frame_image(camera.intrinsics<float>(), static_cast<int>(camera.width),
                       static_cast<int>(camera.height), black, planes);
}

// Adds a window to the tables.
void add_window(const ClusterTable& table, const Camera& camera, const SelectRule& rule,
                const PicturePlanes& planes, WindowTables& windows) {
    const uint32_t w = windows.count++;
    windows.view[w] = view_of_window(table, camera);
    windows.rule[w] = rule;
    windows.placement[w] = {view_of_world<float>(camera), 0, w};
    windows.image[w] = image_of(camera, planes);
    if (w > 0) {
        const FrameImage& before = windows.image[w - 1];
        windows.image[w].first_tile = before.first_tile + num_tiles_of(before);
    }
}

FrameBatch batch_of(const DeviceBuffer<GaussianRows<const float>>& model,
                    const DeviceWindows& windows) {
    return {.models = model.data(),
            .placements = windows.tables()->placement,
            .images = windows.tables()->image,
            .num_images = windows.count(),
            .num_tiles = windows.num_tiles(),
            .has_depth = false};
}

// The gaussians of a step's windows, their pictures, and the backward pass of the
// pictures.
class StepFrame {
  public:
    StepFrame(const FitConfig& config, const GaussianRows<const float>& rows,
              const DeviceTable& table, cudaStream_t stream)
        : appearance_{config.filter_px2, config.antialiased, false},
          rows_(rows),
          table_(table),
          stream_(stream),
          model_(Span<const GaussianRows<const float>>{&rows, 1}, stream) {}

    // Returns as soon as the buffers are known to suffice.
    void draw(const DeviceWindows& windows) {
        const std::unique_ptr<Drawing> drawing = frame_.draw(
            batch_of(model_, windows),
            [&](const ItemList& items, cudaStream_t on) {
                windows.write_items(table_, appearance_, items, on);
            },
            stream_);
        const FrameCounters& counters = drawing->settle();
        num_slots_ = counters.slots;
        num_items_ = static_cast<unsigned>(counters.items);
    }
    // Returns the gradients of the items' gaussians, with kItemSize rows per item.
    // Before the call, the planes of the windows must have the gradients of their
    // pixels. The gradients of items that begin before row `first_wanted` are
    // undefined.
    GaussianRows<float> backward(const DeviceWindows& windows, uint64_t first_wanted) {
        const size_t count = size_t(kItemSize) * num_items_;
        const GaussianRows<float> gradient =
            rows_in(gradients_.reserve(num_values(rows_.sh_degree) * count, stream_), count,
                    rows_.sh_degree);
        const FrameTape tape = frame_.tape();
        const GradientSlots slots{tape.first_slot, slots_.reserve(num_slots_, stream_), nullptr,
                                  is_touched_.reserve(num_slots_, stream_)};
        if (num_slots_ > 0)
            check(cudaMemsetAsync(slots.is_touched, 0, num_slots_, stream_), "cudaMemsetAsync");
        const WindowTables* tables = windows.tables();
        rasterize_backward({.image = {},
                            .records = tape.lists.records,
                            .tile_first = tape.lists.tile_first,
                            .order = tape.raster.order,
                            .blended = tape.raster.blended,
                            .plans = tape.lists.plans,
                            .d_picture = {}},
                           {.images = tables->image,
                            .d_pictures = tables->slope,
                            .num_tiles = windows.num_tiles()},
                           slots, nullptr, nullptr, stream_);
        project_backward({.item_records = tape.item_records,
                          .records = tape.lists.records,
                          .source = tape.source,
                          .rows = rows_,
                          .view = {},
                          .camera = {},
                          .filter_px2 = appearance_.filter_px2,
                          .antialiased = appearance_.antialiased,
                          .has_lenses = false},
                         {.items = tape.items,
                          .num_items = num_items_,
                          .placements = tables->placement,
                          .images = tables->image,
                          .first_wanted = first_wanted},
                         slots, gradient, stream_);
        return gradient;
    }
    ShownCluster shown(const DeviceWindows& windows) const {
        return {.item_of_cluster = windows.item_of_cluster(),
                .num_items = windows.num_items(),
                .num_clusters = table_.table().num_clusters(),
                .num_windows = windows.count()};
    }

  private:
    const Appearance<float> appearance_;
    const GaussianRows<const float> rows_;
    const DeviceTable& table_;
    const cudaStream_t stream_;
    DeviceBuffer<GaussianRows<const float>> model_;
    Frame frame_{Frame::Keeps::tape};
    unsigned long long num_slots_ = 0;
    unsigned num_items_ = 0;
    DeviceBuffer<float> gradients_;
    DeviceBuffer<RecordGradient<float>> slots_;
    DeviceBuffer<uint8_t> is_touched_;
};

// The pictures of all windows of a step, and the gradients of their pixels.
class Canvases {
  public:
    Canvases(unsigned num_windows, cudaStream_t stream)
        : pictures_(4 * kMostPixels * num_windows, stream),
          slopes_(4 * kMostPixels * num_windows, stream) {}

    PicturePlanes picture(size_t window) const {
        return planes_of_window(pictures_.data(), kMostPixels, window);
    }
    PictureGradient<float> slope(size_t window) const {
        const PicturePlanes planes = planes_of_window(slopes_.data(), kMostPixels, window);
        return {planes.color, planes.alpha, nullptr};
    }
    float* slopes() const { return slopes_.data(); }

  private:
    DeviceBuffer<float> pictures_, slopes_;
};

// The input of one step.
struct PlannedStep {
    DeviceWindows windows;
    unsigned blocks_per_window = 0;  // blocks of kThreads pixels
    Event made, used;
};

// Draws pictures of the asset as targets.
class TargetPainter {
  public:
    TargetPainter(const DeviceFitTarget& target, const DeviceTable& table, cudaStream_t stream)
        : target_(target),
          table_(table),
          stream_(stream),
          model_(Span<const GaussianRows<const float>>{&target.rows, 1}, stream) {}

    // Draws the asset in a window. `windows` is temporary memory. The result is stored
    // in `picture`, and may be used on the same stream.
    ReadPlanes draw(const ClusterTable& table, const AssetView& view, WindowTables& windows,
                    DeviceBuffer<float>& picture) {
        const Camera camera = view.window.scaled(view.samples);
        const PicturePlanes larger = planes_in(larger_, num_pixels(camera));
        windows.count = 0;
        add_window(table, camera, SelectRule{}, larger, windows);
        leaves_.cut(table_, windows, Shown::leaves, stream_);
        frame_
            .draw(
                batch_of(model_, leaves_),
                [&](const ItemList& items, cudaStream_t on) {
                    leaves_.write_items(table_, {target_.filter_px2, target_.antialiased, false},
                                        items, on);
                },
                stream_)
            ->finish();
        const size_t count = num_pixels(view.window);
        const PicturePlanes small = planes_in(picture, count);
        launch("average_kernel", average_kernel, blocks_for(count, kThreads), kThreads, 0, stream_,
               larger, small, static_cast<unsigned>(view.window.width),
               static_cast<unsigned>(view.window.height), view.samples);
        return {small.color, small.alpha};
    }

  private:
    PicturePlanes planes_in(DeviceBuffer<float>& memory, size_t count) {
        return planes_of_window(memory.reserve(4 * count, stream_), count, 0);
    }

    const DeviceFitTarget& target_;
    const DeviceTable& table_;
    const cudaStream_t stream_;
    DeviceBuffer<GaussianRows<const float>> model_;
    DeviceBuffer<float> larger_;
    DeviceWindows leaves_;
    Frame frame_;
};

// Plans the windows of steps ahead of time, in other threads. Otherwise the device
// would often wait, because choosing the tolerances of a step takes as long as the step
// itself. A step only waits once for the device.
class StepsAhead {
  public:
    // If `target` is null, there are no target pictures, and each window has a view of
    // its own.
    StepsAhead(const CutPictures& pictures, const DeviceTable& table, const Canvases& canvases,
               uint64_t num_windows, unsigned windows_per_step, unsigned cuts_per_view,
               const DeviceFitTarget* target, cudaStream_t stream)
        : pictures_(pictures),
          table_(table),
          canvases_(canvases),
          num_windows_(num_windows),
          windows_per_step_(windows_per_step),
          cuts_per_view_(cuts_per_view),
          target_(target),
          stream_(stream),
          device_(current_device()),
          num_threads_(num_planners(windows_per_step)),
          workers_(num_threads_),
          views_(kViewSlots),
          steps_(kStepsAhead * num_threads_),
          ahead_(num_steps(), num_threads_, kStepsAhead * num_threads_,
                 [this](uint64_t number) { make(number); }) {}
    // Wait for the stream, because steps on the device may still read the members.
    ~StepsAhead() { cudaStreamSynchronize(stream_); }

    uint64_t num_steps() const {
        return (num_windows_ + windows_per_step_ - 1) / windows_per_step_;
    }
    const PlannedStep& wait_for_next() {
        next_ = &steps_[ahead_.wait_for_next()];
        next_->made.hold_back(stream_);
        return *next_;
    }
    void next_is_used() {
        next_->used.record(stream_);
        ahead_.next_is_used();
    }

  private:
    struct Worker {
        OwnStream stream;
        std::unique_ptr<TargetPainter> painter;
        WindowTables windows{}, scratch{};
    };
    struct View {
        AssetView view;
        std::vector<SelectRule> cuts;
        ReadPlanes target{};
        DeviceBuffer<float> picture;
    };

    PlannedWindow planned(uint64_t number) const {
        if (target_ != nullptr) return planned_window(number, cuts_per_view_);
        return {.view = number, .slot = number % kViewSlots, .cut = 0, .is_new = true};
    }

    void make(uint64_t number) {
        const DeviceGuard guard(device_);
        Worker& worker = workers_[number % num_threads_];
        PlannedStep& step = steps_[number % steps_.size()];
        const cudaStream_t stream = worker.stream.get();
        step.used.hold_back(stream);
        worker.windows.count = 0;
        step.blocks_per_window = 0;
        const uint64_t first = number * windows_per_step_,
                       end = std::min(first + windows_per_step_, num_windows_);
        for (uint64_t n = first; n < end; ++n) {
            const PlannedWindow plan = planned(n);
            View& view = views_[plan.slot];
            if (plan.is_new) renew(plan, worker, view);
            const size_t w = worker.windows.count;
            worker.windows.target[w] = view.target;
            worker.windows.slope[w] = canvases_.slope(w);
            add_window(pictures_.table, view.view.window, view.cuts[plan.cut], canvases_.picture(w),
                       worker.windows);
            step.blocks_per_window =
                std::max(step.blocks_per_window,
                         blocks_for(num_pixels_of_cells(view.view.window), kThreads));
        }
        step.windows.cut(table_, worker.windows, Shown::cuts, stream);
        step.made.record(stream);
    }

    void renew(const PlannedWindow& plan, Worker& worker, View& view) {
        view.view = asset_view(pictures_, plan.view);
        view.cuts = cuts_of_view(pictures_, view.view, plan.view, cuts_per_view_);
        if (target_ == nullptr) return;
        if (worker.painter == nullptr)
            worker.painter = std::make_unique<TargetPainter>(*target_, table_, worker.stream.get());
        view.target =
            worker.painter->draw(pictures_.table, view.view, worker.scratch, view.picture);
    }

    const CutPictures& pictures_;
    const DeviceTable& table_;
    const Canvases& canvases_;
    const uint64_t num_windows_;
    const unsigned windows_per_step_, cuts_per_view_;
    const DeviceFitTarget* const target_;
    const cudaStream_t stream_;
    const int device_;
    const unsigned num_threads_;
    PlannedStep* next_ = nullptr;
    std::vector<Worker> workers_;
    std::vector<View> views_;
    std::vector<PlannedStep> steps_;
    Ahead ahead_;  // This must be the last member, because its threads use all other
                   // members.
};

// Computes the gradients of the loss with respect to the pixels of a step's windows.
class Comparison {
  public:
    Comparison(const LossWeights& loss, const CutComparison& settings, const Canvases& canvases,
               cudaStream_t stream)
        : loss_(loss),
          window_means_(settings.window_means),
          canvases_(canvases),
          stream_(stream),
          sums_(blocks_for(kMostPixels, kThreads) * static_cast<size_t>(settings.windows_per_step),
                stream),
          slopes_(static_cast<size_t>(settings.windows_per_step), stream) {}

    void compare(const PlannedStep& step) {
        const WindowTables* windows = step.windows.tables();
        const dim3 grid(step.blocks_per_window, step.windows.count());
        launch("compare_kernel", compare_kernel, grid, kThreads, 0, stream_, windows, loss_,
               kMostPixels, canvases_.slopes(), sums_.data());
        launch("weigh_kernel", weigh_kernel, step.windows.count(), kThreads, 0, stream_, windows,
               loss_, window_means_, sums_.data(), step.blocks_per_window, slopes_.data());
        launch("weigh_slopes_kernel", weigh_slopes_kernel, grid, kThreads, 0, stream_, windows,
               kMostPixels, slopes_.data(), canvases_.slopes());
    }

  private:
    const LossWeights loss_;
    const float window_means_;
    const Canvases& canvases_;
    const cudaStream_t stream_;
    DeviceBuffer<WindowSums> sums_;
    DeviceBuffer<WindowSlopes> slopes_;
};

// Returns the grid for kernels that process the gaussians of clusters, starting with
// cluster `first`.
dim3 grid_of_clusters(const ClusterTable& table, size_t first) {
    int64_t most = 1;
    for (size_t c = first; c < table.num_clusters(); ++c)
        most = std::max(most, table.num_gaussians(c));
    return dim3(static_cast<unsigned>(table.num_clusters() - first),
                blocks_for(static_cast<size_t>(most), kItemSize));
}

}  // namespace

void refine_cuts(const FitConfig& config, const CutComparison& comparison,
                 const DeviceFitTarget& target, const CutRows& levels, const CutPictures& pictures,
                 FitProgress& progress, Stream stream) {
    const GaussianRows<float>& rows = levels.rows;
    const size_t num = num_values(rows.sh_degree), num_moments = 2 * num * rows.size;
    const DeviceBuffer<float> moments(num_moments, stream), radius(levels.radius, stream);
    if (num_moments > 0)
        check(cudaMemsetAsync(moments.data(), 0, num_moments * sizeof(float), stream),
              "cudaMemsetAsync");
    const auto windows_per_step = static_cast<unsigned>(comparison.windows_per_step);
    const DeviceTable table(pictures.table, stream);
    const Canvases canvases(windows_per_step, stream);
    StepFrame frame(config, rows, table, stream);
    Comparison compared(config.loss, comparison, canvases, stream);
    const Span<const int64_t>& offset = pictures.table.offset;
    const auto first_moving = static_cast<size_t>(
        std::lower_bound(offset.begin(), offset.end(), static_cast<int64_t>(target.rows.size)) -
        offset.begin());
    const dim3 grid = grid_of_clusters(pictures.table, first_moving);
    check(cudaStreamSynchronize(stream),
          // After this wait, every stream can read the memory that pictures are drawn
          // from.
          "refine_cuts");
    StepsAhead ahead(pictures, table, canvases, uint64_t(config.steps) * windows_per_step,
                     windows_per_step, static_cast<unsigned>(comparison.cuts_per_view), &target,
                     stream);
    for (int i = 0; i < config.steps && !progress.cancel; ++i) {
        const PlannedStep& step = ahead.wait_for_next();
        frame.draw(step.windows);
        compared.compare(step);
        const GaussianRows<float> gradient = frame.backward(step.windows, target.rows.size);
        launch("move_kernel", move_kernel, grid, kItemSize, 0, stream, frame.shown(step.windows),
               table.table().offset, first_moving, rows, gradient, radius.data(),
               fit_step(config, i), config.beta2,
               Moments{moments.data(), moments.data() + num * rows.size});
        ahead.next_is_used();
        progress.groups_done += windows_per_step;
    }
    check(cudaStreamSynchronize(stream), "refine_cuts");
}

void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& rows,
                const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress,
                Stream stream) {
    constexpr unsigned kWindowsPerStep = 8;
    const DeviceBuffer<double> weights(Span<const double>(seen.weight), stream);
    const DeviceBuffer<int32_t> num_looks(Span<const int32_t>(seen.num_looks), stream);
    const DeviceBuffer<float> grey(3 * rows.size, stream);
    if (rows.size > 0)
        check(cudaMemsetAsync(grey.data(), 0, grey.bytes(), stream), "cudaMemsetAsync");
    // If a gaussian is grey, the gradient with respect to its colour measures how much
    // of it is visible.
    GaussianRows<const float> rows_in_grey = rows;
    rows_in_grey.sh = grey.data();
    rows_in_grey.sh_degree = 0;
    const DeviceTable table(pictures.table, stream);
    const Canvases canvases(kWindowsPerStep, stream);
    StepFrame frame(config, rows_in_grey, table, stream);
    const dim3 grid = grid_of_clusters(pictures.table, 0);
    check(cudaStreamSynchronize(stream), "weigh_cuts");
    StepsAhead ahead(pictures, table, canvases, static_cast<uint64_t>(config.steps),
                     kWindowsPerStep, 1, nullptr, stream);
    for (uint64_t i = 0; i < ahead.num_steps() && !progress.cancel; ++i) {
        const PlannedStep& step = ahead.wait_for_next();
        frame.draw(step.windows);
        launch("sum_slope_kernel", sum_slope_kernel,
               dim3(step.blocks_per_window, step.windows.count()), kThreads, 0, stream,
               step.windows.tables(), kMostPixels, canvases.slopes());
        launch("weight_kernel", weight_kernel, grid, kItemSize, 0, stream,
               frame.shown(step.windows), step.windows.tables(), table.table().offset,
               frame.backward(step.windows, 0), weights.data(), num_looks.data());
        ahead.next_is_used();
        progress.groups_done += step.windows.count();
    }
    check(cudaMemcpyAsync(seen.weight.data, weights.data(), seen.weight.size * sizeof(double),
                          cudaMemcpyDeviceToHost, stream),
          "weigh_cuts");
    check(cudaMemcpyAsync(seen.num_looks.data, num_looks.data(),
                          seen.num_looks.size * sizeof(int32_t), cudaMemcpyDeviceToHost, stream),
          "weigh_cuts");
    check(cudaStreamSynchronize(stream), "weigh_cuts");
}

}  // namespace cuda
}  // namespace v3dg
