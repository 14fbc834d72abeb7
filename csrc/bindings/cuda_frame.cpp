// Models, scenes, pools and frames on CUDA devices. Frames are enqueued on torch's
// current stream. The GIL is held while they are enqueued, because torch allocates the
// pictures. A Turn keeps other threads from using the buffers of a frame.

#include "bindings/cuda_frame.h"

#include "draw/render_backward_cuda.h"

namespace v3dg::cuda {

namespace {

class BackendModel final : public backend::Model {
  public:
    BackendModel(const Rows& rows, const Work& work) : rows_(rows) {
        on_device_.packed = std::make_shared<PackedModel>(rows.read<float>(), stream_of(work));
    }
    BackendModel(const CodedPages& pages, const Work& work) {
        const Unlocked unlocked;
        on_device_.coded = std::make_shared<CodedModel>(pages, stream_of(work));
    }

    const DeviceModel& on_device() const { return on_device_; }

    size_t bytes() const override {
        if (on_device_.coded != nullptr) return on_device_.coded->bytes();
        return on_device_.packed->bytes() +
               rows_->size() * sizeof(float) * (11 + 3 * num_sh_bases(rows_->sh_degree()));
    }
    void decode(Span<const int32_t> clusters, Span<const int64_t> offset, const Work& work,
                const GaussianRows<float>& out) const override {
        cuda::decode({on_device_.coded->codes(), clusters, offset}, out, stream_of(work));
    }

  private:
    std::optional<Rows> rows_;  // memory that the packed model reads
    DeviceModel on_device_;
};

class BackendPalette final : public backend::Palette {
  public:
    BackendPalette(const BoundTable& table, Span<const float> sh, const Work& work)
        : palette(std::make_shared<DevicePalette>(sh, tables_on(table, work), stream_of(work))) {}

    const std::shared_ptr<const DevicePalette> palette;
};

class BackendScene final : public backend::Scene {
  public:
    const SceneTables& tables() const { return tables_; }

    void set_bundles(const SceneState& state, const Work& work) override {
        std::vector<std::shared_ptr<const BundleTables>> tables;
        for (size_t b = 0; b < state.tables.size(); ++b)
            tables.push_back(tables_on(state.bundle(b), work));
        tables_.set_bundles(std::move(tables), stream_of(work));
    }
    void set_instances(SceneState& state, const Work& work) override {
        const Poses poses(state);
        tables_.set_instances(state.instances.bundle, state.instances.importance,
                              state.instances.factors, state.environments->table(),
                              stream_of(work));
        tables_.set_labels(state.label_span(), stream_of(work));
        poses.give_to(tables_, work);
    }
    void set_poses(SceneState& state, const Work& work) override {
        Poses(state).give_to(tables_, work);
    }
    void select(const SceneState&, const Eyes& eyes, const SelectRule& rule, uint32_t* last_bin,
                const Work& work, SelectOutput& out) const override {
        cut_.select(tables_, eyes, rule, out, stream_of(work), nullptr, last_bin);
    }

  private:
    // Poses may be on the host or on the device.
    struct Poses {
        PoseSpan positions, quaternions, scales;

        explicit Poses(const SceneState& state) {
            const auto count = static_cast<py::ssize_t>(state.instances.bundle.size);
            positions = doubles_anywhere(state.arrays[2], "positions", {count, 3});
            quaternions = doubles_anywhere(state.arrays[3], "quaternions", {count, 4});
            scales = doubles_anywhere(state.arrays[4], "scales", {count});
        }
        void give_to(SceneTables& tables, const Work& work) const {
            tables.set_poses(positions, quaternions, scales, stream_of(work));
        }
    };

    static PoseSpan doubles_anywhere(const py::handle& array, const char* name,
                                     const Shape& shape) {
        if (device_of(array, name) == kHost)
            return {.values = span_of<const double>(array, name, shape), .is_on_device = false};
        const Borrowed borrowed = borrow_anywhere(array, name, element_of<double>(), shape);
        return {.values = {static_cast<const double*>(borrowed.data), borrowed.size},
                .is_on_device = true};
    }

    SceneTables tables_;
    mutable Cut cut_;
};

}  // namespace

const SceneTables& tables_of(const backend::Scene& scene) {
    return static_cast<const BackendScene&>(scene).tables();
}

const DeviceModel& model_on_device(const backend::Model& model) {
    return static_cast<const BackendModel&>(model).on_device();
}

FrameImage image_of(const Camera& eye, const Shade& shade, const PicturePlanes& planes) {
    const std::array<double, 3>& color = shade.background;
    const float background[3] = {float(color[0]), float(color[1]), float(color[2])};
    return frame_image(eye.intrinsics<float>(), static_cast<int>(eye.width),
                       static_cast<int>(eye.height), background, planes);
}

namespace {

class BackendPool final : public backend::Pool {
  public:
    explicit BackendPool(std::unique_ptr<DevicePages> pages) : pages_(std::move(pages)) {}

    DevicePages& pages() { return *pages_; }

    SettlingStep settle_step(const backend::Scene& scene, const SceneState&, const Eyes& eyes,
                             const SelectRule& rule, bool begins, const Work& work) override {
        return pages_->settle_step(tables_of(scene), eyes, rule, begins, stream_of(work));
    }

  private:
    std::unique_ptr<DevicePages> pages_;
};

// A frame that was enqueued.
class EnqueuedDrawing final : public BoundDrawing {
  public:
    EnqueuedDrawing(NewPictures pictures, Device device, std::shared_ptr<Mutex> turns,
                    std::unique_ptr<Drawing> drawing, const SelectRule& rule, DevicePages* pages)
        : BoundDrawing(std::move(pictures), FrameStats{}),
          device_(device),
          turns_(std::move(turns)),
          drawing_(std::move(drawing)),
          pages_(pages),
          rule_(rule) {}

    bool is_under_way() const override { return true; }

    const FrameStats& finish() override {
        const Work work(device_);
        {
            const Unlocked unlocked;
            drawing_->wait();
        }
        const Turn turn(*turns_);
        // this may draw the frame again
        const FrameCounters& counters = drawing_->finish();
        if (pages_ != nullptr) pages_->note_frames(stream_of(work));
        const FrameTimes times = drawing_->times();
        const bool exceeds = counters.choice.exceeds_budget;
        const auto selected =
            exceeds ? counters.choice.least : counters.gaussians / pictures_.size();
        stats_ = {.gaussians = static_cast<int64_t>(selected),
                  .in_frustum = counters.in_frustum,
                  .records = counters.records,
                  .entries = counters.entries,
                  .items = counters.items,
                  .tolerance_px2 = rule_.budget == kNoBudget ? rule_.tolerance_px2
                                                             : counters.choice.tolerance_px2,
                  .exceeds_budget = exceeds,
                  .select_ms = times.prepare_ms,
                  .draw_ms = times.draw_ms,
                  .levels = {},
                  .num_draws = drawing_->num_draws()};
        return stats_;
    }

  private:
    const Device device_;
    const std::shared_ptr<Mutex> turns_;  // shared with the frame
    // must be destroyed before the objects that it uses
    const std::unique_ptr<Drawing> drawing_;
    DevicePages* const pages_;  // the pool that provides the gaussians; may be null
    const SelectRule rule_;
};

// A batch that was enqueued.
class EnqueuedBatch final : public BoundBatch {
  public:
    EnqueuedBatch(Device device, std::shared_ptr<Mutex> turns,
                  std::unique_ptr<BatchDrawing> drawing)
        : device_(device), turns_(std::move(turns)), drawing_(std::move(drawing)) {}

    void finish() override {
        if (is_finished_) return;
        const Work work(device_);
        {
            const Unlocked unlocked;
            drawing_->wait();
        }
        const Turn turn(*turns_);
        drawing_->finish();  // this may draw parts again
        is_finished_ = !drawing_->is_captured();
    }

    BatchStats stats() override {
        finish();
        const Work work(device_);
        const Turn turn(*turns_);
        BatchStats stats;
        for (const ImageCounts& counts : drawing_->counts()) {
            stats.gaussians.push_back(static_cast<int64_t>(counts.gaussians));
            stats.in_frustum.push_back(static_cast<int64_t>(counts.in_frustum));
        }
        const FrameTimes times = drawing_->times();
        stats.select_ms.push_back(times.prepare_ms);
        stats.draw_ms.push_back(times.draw_ms);
        stats.num_parts = static_cast<int>(drawing_->num_parts());
        return stats;
    }

  private:
    const Device device_;
    const std::shared_ptr<Mutex> turns_;  // shared with the frame
    // Must be destroyed before the objects that it uses.
    const std::unique_ptr<BatchDrawing> drawing_;
    bool is_finished_ = false;
};

CameraArrays arrays_of(const BoundCameras& cameras) {
    return {.viewmats = cameras.viewmats().data,
            .intrinsics = cameras.intrinsics().data,
            .environments = cameras.environments().data,
            .are_viewmats_double = cameras.viewmats().are_double,
            .are_intrinsics_double = cameras.intrinsics().are_double,
            .shares_intrinsics = cameras.shares_intrinsics(),
            .are_environments_long = cameras.environments().are_long,
            .width = cameras.width(),
            .height = cameras.height(),
            .near_depth = cameras.near_depth()};
}

PicturePlanes planes_of(NewPicture& picture, Device device) {
    const NewPlanes<float> planes = picture.allocate<float>(device);
    return {planes.color, planes.alpha, planes.depth, false};
}

// Returns the pictures of the eyes. Their memory is not allocated yet.
EyeImages new_images(const Eyes& eyes, const Shade& shade, NewPictures& pictures) {
    FrameImage image[2]{};
    for (int k = 0; k < eyes.count(); ++k) {
        const Camera& eye = eyes.camera[k];
        const Window whole{0, 0, static_cast<int>(eye.width), static_cast<int>(eye.height)};
        pictures.emplace_back(whole, shade.with_depth);
        image[k] = image_of(eye, shade);
    }
    const float stop = shade.min_transmittance;
    return eyes.are_two ? images_of_eyes(image[0], image[1], stop)
                        : EyeImages{{image[0], {}}, 1, stop};
}

// Allocates the channels of pictures, and returns them with the meshes.
FrameSensors new_sensors(const SensorRequest& request, NewPictures& pictures, Device device) {
    if (!request.is_on()) return {};
    Sensor sensors[2]{};
    for (size_t k = 0; k < pictures.size(); ++k) {
        const SensorPlanes planes = pictures[k].channels.allocate(
            device, request.channels, {pictures[k].height, pictures[k].width});
        const auto num_pixels = static_cast<size_t>(pictures[k].height * pictures[k].width);
        sensors[k] = {.planes = planes, .mesh = request.mesh.from(k * num_pixels)};
    }
    return {.first = sensors[0], .second = sensors[1]};
}

// Returns a function that allocates the pictures through torch. The frame calls it
// after its first kernels are enqueued, because allocation is slow.
cuda::Frame::Place place_of(NewPictures& pictures, Device device) {
    return [&pictures, device](PicturePlanes planes[2]) {
        for (size_t k = 0; k < pictures.size(); ++k) planes[k] = planes_of(pictures[k], device);
    };
}

class BackendFrame final : public backend::Frame {
  public:
    explicit BackendFrame(Device device) : device_(device) {}

    void set_models(std::vector<std::shared_ptr<const backend::Model>> models,
                    std::vector<std::shared_ptr<const backend::Palette>> palettes,
                    const Work& work) override {
        std::vector<DeviceModel> on_device;
        for (const std::shared_ptr<const backend::Model>& model : models)
            on_device.push_back(static_cast<const BackendModel&>(*model).on_device());
        std::vector<std::shared_ptr<const DevicePalette>> colors;
        for (const std::shared_ptr<const backend::Palette>& palette : palettes)
            colors.push_back(static_cast<const BackendPalette&>(*palette).palette);
        const Turn turn(*turns_);
        frame_.set_models(std::move(on_device), std::move(colors), stream_of(work));
        models_ = std::move(models);
    }

    std::unique_ptr<BoundDrawing> draw(const backend::FrameInput& input) override {
        const FrameRequest& request = input.request;
        if (request.cut) return enqueue(input, request.rule);
        return in_steps(input.steps, request.rule, request.choosing_eyes(), input.state,
                        [&](const SelectRule& paced, uint32_t*) { return enqueue(input, paced); });
    }

    std::unique_ptr<BoundBatch> draw_batch(const backend::BatchInput& input) override {
        const Turn turn(*turns_);
        const Work work(device_);
        return std::make_unique<EnqueuedBatch>(
            device_, turns_,
            frame_.draw_batch(tables_of(input.scene), input.request, arrays_of(input.cameras),
                              static_cast<uint32_t>(input.cameras.size()), stream_of(work)));
    }

    bool pick(const backend::FrameInput&, ScenePick&) override {
        throw py::value_error("pick: expected a frame on the CPU, got one on a CUDA device");
    }

    std::vector<std::pair<const char*, size_t>> memory() const override {
        std::vector<std::pair<const char*, size_t>> parts = bytes_of_frame();
        const PoolBytes pool = pool_bytes();
        parts.emplace_back("pool, reserved", pool.reserved);
        parts.emplace_back("pool, used", pool.used);
        return parts;
    }

  private:
    std::unique_ptr<BoundDrawing> enqueue(const backend::FrameInput& input,
                                          const SelectRule& paced) {
        const FrameRequest& request = input.request;
        const Turn turn(*turns_);
        const Work work(device_);
        NewPictures pictures;
        const EyeImages images = new_images(request.eyes, request.shade, pictures);
        DevicePages* const pages =
            input.pool == nullptr ? nullptr : &static_cast<BackendPool&>(*input.pool).pages();
        const FrameSensors sensors = new_sensors(request.sensor, pictures, device_);
        SelectRule used = paced;
        std::unique_ptr<Drawing> drawing =
            frame_.draw(tables_of(input.scene), pages, request, used, images, sensors,
                        stream_of(work), place_of(pictures, device_));
        // Report the tolerance of the request or, with a pool, the tolerance that the
        // pool may have raised.
        const SelectRule& reported = pages == nullptr ? request.rule : used;
        return std::make_unique<EnqueuedDrawing>(std::move(pictures), device_, turns_,
                                                 std::move(drawing), reported, pages);
    }

    std::vector<std::pair<const char*, size_t>> bytes_of_frame() const {
        const Turn turn(*turns_);
        return frame_.bytes();
    }

    const Device device_;
    // Shared with drawings, which may be finished after the frame is destroyed.
    const std::shared_ptr<Mutex> turns_ = std::make_shared<Mutex>();
    // The members below own the memory that the frame reads.
    std::vector<std::shared_ptr<const backend::Model>> models_ V3DG_GUARDED_BY(*turns_);
    SceneFrame frame_ V3DG_GUARDED_BY(*turns_);
};

class BackendAssetFrame final : public backend::AssetFrame {
  public:
    BackendAssetFrame(std::shared_ptr<const backend::Model> model, Appearance<float> appearance,
                      Device device)
        : device_(device), model_(std::move(model)), appearance_(appearance) {}

    std::unique_ptr<BoundDrawing> draw(const Camera& camera, const Shade& shade,
                                       const SensorRequest& sensor,
                                       const std::atomic<bool>*) override {
        const Turn turn(*turns_);
        const Work work(device_);
        NewPictures pictures;
        const EyeImages images = new_images(camera, shade, pictures);
        const FrameSensors sensors = new_sensors(sensor, pictures, device_);
        const PackedModel& packed = *static_cast<const BackendModel&>(*model_).on_device().packed;
        std::unique_ptr<Drawing> drawing =
            frame_.draw(packed.rows(), view_of_world<float>(camera), appearance_.filter_px2,
                        appearance_.antialiased, images.image[0], stream_of(work), &packed.packed(),
                        images.min_transmittance, place_of(pictures, device_), sensors,
                        clipped_pictures(camera, images, sensors));
        return std::make_unique<EnqueuedDrawing>(std::move(pictures), device_, turns_,
                                                 std::move(drawing), SelectRule{}, nullptr);
    }

  private:
    const Device device_;
    const std::shared_ptr<Mutex> turns_ = std::make_shared<Mutex>();
    const std::shared_ptr<const backend::Model> model_;
    const Appearance<float> appearance_;
    ModelFrame frame_ V3DG_GUARDED_BY(*turns_);
};

class DeviceTape final : public Tape {
  public:
    // Keeps the gaussians alive, because backward() reads them again.
    DeviceTape(const Rows& gaussians, std::unique_ptr<DifferentiableFrame> frame,
               py::ssize_t height, py::ssize_t width)
        : gaussians_(gaussians), frame_(std::move(frame)), height_(height), width_(width) {}
    ~DeviceTape() override { give_back(std::move(frame_)); }

    Gradients backward(const py::object& d_color, const py::object& d_alpha,
                       const py::object& d_depth, Centers wanted) override {
        const py::ssize_t h = height_;
        const py::ssize_t w = width_;
        const Device device = gaussians_.device();
        const Work work(device);
        const GradientPlane<float> color(d_color, "d_color", device, {h, w, 3});
        const GradientPlane<float> alpha(d_alpha, "d_alpha", device, {h, w});
        const PictureGradient<float> d_picture{
            color.span.data, alpha.span.data,
            elements_or_null<const float>(device, d_depth, "d_depth", {h, w})};
        const NewRows gradients(device, gaussians_.size(), gaussians_.sh_degree());
        const NewArray<float> background(device, {3});
        Gradients made{.means = gradients.means.object,
                       .quats = gradients.quats.object,
                       .scales = gradients.scales.object,
                       .opacities = gradients.opacities.object,
                       .sh = gradients.sh.object,
                       .background = background.object};
        CenterGradients<float> centers{};
        const Shape pairs{static_cast<py::ssize_t>(gaussians_.size()), 2};
        if (wanted.sum) centers.sum = new_elements<float>(device, pairs, made.centers);
        if (wanted.size)
            centers.size = reinterpret_cast<CenterSize<float>*>(
                new_elements<float>(device, pairs, made.center_sizes));
        {
            const Unlocked unlocked;
            frame_->backward(d_picture, gradients.rows(), centers, background.span.data,
                             stream_of(work));
        }
        return made;
    }

  private:
    Rows gaussians_;
    std::unique_ptr<DifferentiableFrame> frame_;
    py::ssize_t height_, width_;
};

}  // namespace

std::shared_ptr<const BundleTables> tables_on(const BoundTable& table, const Work& work) {
    const std::shared_ptr<const backend::Tables> tables = table.on(work);
    return {tables, &static_cast<const BackendTables&>(*tables).tables};
}

std::shared_ptr<const backend::Model> make_model(const Rows& rows, const Work& work) {
    return std::make_shared<BackendModel>(rows, work);
}

std::shared_ptr<const backend::Model> make_model(const py::object& codes, const Work& work) {
    return std::make_shared<BackendModel>(held<BoundCodes>(codes, "codes").pages(), work);
}

std::shared_ptr<const backend::Palette> make_palette(const py::object& table, const py::array& sh,
                                                     const Work& work) {
    const auto& bound = held<BoundTable>(table, "table");
    const auto clusters = static_cast<py::ssize_t>(bound.table().num_clusters());
    const Span<const float> colors = span_of<const float>(sh, "sh", {clusters, 3});
    return std::make_shared<BackendPalette>(bound, colors, work);
}

std::unique_ptr<backend::Scene> make_scene() { return std::make_unique<BackendScene>(); }

std::unique_ptr<backend::Pool> make_pool(PagePool& pool, const py::list& tables, const Work& work) {
    std::vector<std::shared_ptr<const BundleTables>> on_device;
    std::vector<ClusterTable> host;
    std::vector<ClusterAppearance> appearance;
    for (const py::handle& table : tables) {
        const auto& bound = held<BoundTable>(table, "tables");
        on_device.push_back(tables_on(bound, work));
        host.push_back(bound.table());
        appearance.push_back(bound.appearance());
    }
    return std::make_unique<BackendPool>(std::make_unique<DevicePages>(
        pool, std::move(on_device), host, appearance, stream_of(work)));
}

std::unique_ptr<backend::Frame> make_frame(const Work& work) {
    return std::make_unique<BackendFrame>(work.device());
}

std::unique_ptr<backend::AssetFrame> make_asset_frame(std::shared_ptr<const backend::Model> model,
                                                      Appearance<float> appearance,
                                                      const Work& work) {
    return std::make_unique<BackendAssetFrame>(std::move(model), appearance, work.device());
}

Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                     bool with_depth, bool keep_tape) {
    const Device device = gaussians.device();
    const Work work(device);
    NewPicture made({0, 0, camera.width(), camera.height()}, with_depth);
    const ModelPicture in{.rows = look.read<float>(gaussians),
                          .view = view_of_world<float>(camera.camera),
                          .filter_px2 = static_cast<float>(look.filter_px2),
                          .antialiased = look.antialiased,
                          .image = image_of(camera.camera, Shade{.background = look.background},
                                            planes_of(made, device))};
    std::unique_ptr<DifferentiableFrame> frame;
    {
        const Unlocked unlocked;
        frame = take_frame();
        frame->draw(in, stream_of(work));
    }
    auto tape = std::make_unique<DeviceTape>(gaussians, std::move(frame), made.height, made.width);
    return {.color = made.color,
            .alpha = made.alpha,
            .depth = made.depth,
            .counts = {},
            .tape = keep_tape ? std::move(tape) : nullptr};
}

}  // namespace v3dg::cuda
