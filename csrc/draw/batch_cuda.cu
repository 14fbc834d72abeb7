// Draws batches of pictures of a scene on a CUDA device. A batch is drawn as one frame
// with a picture for each camera. A large batch is divided into several such frames.
// The first kernel of a frame copies the cameras, because the caller may change its
// arrays before a frame must be drawn again.

#include <algorithm>
#include <new>
#include <stdexcept>

#include "base/launch.cuh"
#include "draw/scene_frame_cuda.h"

namespace v3dg {
namespace cuda {

namespace {

// Limits of a part of a batch, which bound its memory. The limit on gaussians assumes a
// few gaussians per pixel. If there are more and memory does not suffice, smaller parts
// are drawn. Parts with more pixels would not be faster, because a part already takes
// milliseconds.
constexpr size_t kMostPixels = size_t(1) << 23;
constexpr size_t kMostPlaces = size_t(1) << 21;
constexpr size_t kMostParts = size_t(1) << 24;

FrameImage first_image(const BatchRequest& request) {
    const std::array<double, 3>& color = request.shade.background;
    const float background[3] = {float(color[0]), float(color[1]), float(color[2])};
    return frame_image(Intrinsics<float>{}, request.width, request.height, background, {});
}

// Returns bounds on what one camera sees.
const SeenBounds& seen_of(const SceneTables& scene, const CameraArrays& arrays) {
    return arrays.environments == nullptr ? scene.seen_by_all() : scene.seen_in_environment();
}

// Returns the maximum number of cameras in a part, at least 1.
uint32_t cameras_of_part(const BatchRequest& request, const SeenBounds& seen) {
    const size_t pixels = static_cast<size_t>(request.width) * request.height;
    const size_t most = std::min({kMostPixels / pixels, kMostPlaces / batch_slots(seen.instances),
                                  kMostParts / std::max<size_t>(seen.parts, 1)});
    return static_cast<uint32_t>(std::max<size_t>(most, 1));
}

}  // namespace

std::shared_ptr<BatchTables> SceneFrame::tables_for(uint32_t num_cameras, cudaStream_t stream) {
    const auto is_free = [num_cameras](const std::shared_ptr<BatchTables>& tables) {
        return tables.use_count() == 1 && tables->cameras.capacity() >= num_cameras;
    };
    const auto found = std::find_if(tables_.begin(), tables_.end(), is_free);
    if (is_capturing(stream)) {
        if (found == tables_.end()) refuse_capture(stream);
        captured_tables_.push_back(*found);
        return *found;
    }
    if (found != tables_.end()) return *found;
    std::erase_if(tables_, [](const auto& tables) { return tables.use_count() == 1; });
    // Allocate one more table than this batch needs, because a later capture must not
    // allocate.
    for (int k = 0; k < 2; ++k)
        tables_.push_back(std::make_shared<BatchTables>(std::max(num_cameras, 1u), stream));
    return tables_.back();
}

std::unique_ptr<BatchDrawing> SceneFrame::draw_batch(const SceneTables& scene,
                                                     const BatchRequest& request,
                                                     const CameraArrays& arrays,
                                                     uint32_t num_cameras, cudaStream_t stream) {
    std::unique_ptr<BatchDrawing> batch(
        new BatchDrawing(*this, scene, request, arrays, num_cameras, stream));
    batch->enqueue(0, num_cameras);
    return batch;
}

void SceneFrame::halve_parts(uint32_t num_cameras) {
    part_limit_.halve(num_cameras);
    frame_.release_buffers();
}

std::unique_ptr<Drawing> SceneFrame::draw_part(const BatchDrawing& batch, uint32_t first,
                                               uint32_t count, CameraSource source) {
    const cudaStream_t stream = batch.stream_;
    const BatchRequest& request = batch.request_;
    const SceneTables& scene = batch.scene_;
    const SeenBounds& seen = seen_of(scene, batch.arrays_);
    const FrameImage image = first_image(request);
    const size_t num_pixels = static_cast<size_t>(request.width) * request.height;
    const BatchViews views{.arrays = batch.arrays_,
                           .first_camera = first,
                           .num_cameras = count,
                           .source = source,
                           .cameras = batch.tables_->cameras.data() + first,
                           .num_slots = static_cast<uint32_t>(batch_slots(seen.instances)),
                           .most_parts = seen.parts,
                           .first = image,
                           .planes = request.planes.from(first * num_pixels),
                           .counts = batch.tables_->counts.data() + first};
    const bool has_factors = !scene.on_device().instances.factors.empty();
    const BatchPlacements out{
        .images = images_.reserve(count, stream),
        .placements = placements_.reserve(views.num_places(), stream),
        .factors = has_factors ? factors_.reserve(views.num_places(), stream) : nullptr};
    const FrameBatch of_cameras{
        .models = rows_.data(),
        .placements = out.placements,
        .images = out.images,
        .num_images = count,
        .num_tiles = count * num_tiles_of(image),
        .packed = has_packed_ ? packed_.data() : nullptr,
        .coded = has_coded_ ? coded_.data() : nullptr,
        .has_shared_items = seen.instances > 1,
        .min_transmittance =
            stop_of_cut(request.shade.min_transmittance, request.rule.tolerance_px2),
        .has_faded_items = request.rule.fade.is_on(),
        .factors = out.factors,
        .num_factors = static_cast<uint32_t>(views.num_places()),
        .guards_models = nullptr,
        .num_zeros = Cut::num_batch_zeros(views.num_places()),
        .has_depth = request.planes.depth != nullptr,
        .image_counts = views.counts,
        .marks_undrawn = true,
        .sensors = {.first = request.sensor.from(first * num_pixels),
                    .second = {},
                    .num_pixels = num_pixels},
        .sensed_scene = {.scene = &scene, .num_slots = views.num_slots, .cameras = views.cameras}};
    const ClippedPictures clipped{.sensors = of_cameras.sensors,
                                  .cameras = views.cameras,
                                  .count = count,
                                  .width = request.width,
                                  .height = request.height};
    return frame_.draw(
        of_cameras,
        [=, this, &scene, &seen, rule = request.rule](const ItemList& items, cudaStream_t on) {
            cut_.cut_batch(scene, views, rule, out, items, on);
            if (clipped.is_on())
                clipped_.mark_scene(scene, seen, clipped, drawn_models(), rule, nullptr, on);
        },
        stream);
}

BatchDrawing::BatchDrawing(SceneFrame& frame, const SceneTables& scene, const BatchRequest& request,
                           const CameraArrays& arrays, uint32_t num_cameras, cudaStream_t stream)
    : frame_(frame),
      scene_(scene),
      request_(request),
      arrays_(arrays),
      num_cameras_(num_cameras),
      tables_(frame.tables_for(num_cameras, stream)),
      stream_(stream),
      is_captured_(is_capturing(stream)) {}

void BatchDrawing::enqueue(uint32_t first, uint32_t count) {
    const SeenBounds& seen = seen_of(scene_, arrays_);
    const uint32_t end = first + count, wanted = cameras_of_part(request_, seen);
    // A captured batch has the parts of the batch that was drawn before the capture.
    if (!is_captured_) frame_.part_limit_.begin_batch(std::min(wanted, count));
    while (first < end) {
        const uint32_t most = std::min(wanted, frame_.part_limit_.most_cameras());
        const uint32_t size = std::min(most, end - first);
        try {
            parts_.push_back(
                {.first = first,
                 .count = size,
                 .drawing = frame_.draw_part(*this, first, size, CameraSource::arrays)});
            first += size;
            continue;
        } catch (const OutOfMemory&) {
            if (size == 1 || is_captured_) throw;
        } catch (const std::length_error&) {  // an earlier batch may have caused this
                                              // error
            if (size == 1 || is_captured_) throw;
        }
        frame_.halve_parts(size);
    }
}

void BatchDrawing::wait() const {
    for (const Part& part : parts_) part.drawing->wait();
}

void BatchDrawing::finish() {
    if (is_captured_) {
        for (const Part& part : parts_) part.drawing->finish();
        return;
    }
    std::vector<Part> finished;
    std::vector<Part> parts = std::move(parts_);
    for (Part& part : parts) finish_part(std::move(part), finished);
    parts_ = std::move(finished);
}

void BatchDrawing::finish_part(Part part, std::vector<Part>& finished) {
    try {
        while (!part.drawing->finish_or_enlarge()) {
            part.drawing.reset();
            part.drawing = frame_.draw_part(*this, part.first, part.count, CameraSource::copies);
        }
        finished.push_back(std::move(part));
        return;
    } catch (const OutOfMemory&) {
        if (part.count == 1) throw;
    } catch (const std::length_error&) {
        if (part.count == 1) throw;
    }
    part.drawing.reset();
    frame_.halve_parts(part.count);
    const uint32_t half = part.count / 2;
    const Part halves[2] = {
        {.first = part.first, .count = half, .drawing = nullptr},
        {.first = part.first + half, .count = part.count - half, .drawing = nullptr}};
    for (const Part& one : halves)
        finish_part(
            {.first = one.first,
             .count = one.count,
             .drawing = frame_.draw_part(*this, one.first, one.count, CameraSource::copies)},
            finished);
}

std::vector<ImageCounts> BatchDrawing::counts() const {
    std::vector<ImageCounts> counts(num_cameras_);
    check(cudaMemcpyAsync(counts.data(), tables_->counts.data(), num_cameras_ * sizeof(ImageCounts),
                          cudaMemcpyDeviceToHost, stream_),
          "cudaMemcpyAsync of counts");
    check(cudaStreamSynchronize(stream_), "cudaStreamSynchronize");
    return counts;
}

FrameTimes BatchDrawing::times() const {
    FrameTimes times{0.0f, 0.0f};
    for (const Part& part : parts_) {
        const FrameTimes own = part.drawing->times();
        times.prepare_ms += own.prepare_ms;
        times.draw_ms += own.draw_ms;
    }
    return times;
}

}  // namespace cuda
}  // namespace v3dg
