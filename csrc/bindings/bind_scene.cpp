#include <memory>
#include <vector>

#include "bindings/operations.h"
#include "bindings/picture.h"
#include "bindings/tables.h"
#include "pipeline/model.h"
#include "pipeline/scene_frame.h"

namespace v3dg {

namespace {

// Asks, from any thread, for work under way to end early.
class Stop {
  public:
    void request() { requested_.store(true, std::memory_order_relaxed); }
    bool is_requested() const { return requested_.load(std::memory_order_relaxed); }
    const std::atomic<bool>* flag() const { return &requested_; }

  private:
    std::atomic<bool> requested_{false};
};

const std::atomic<bool>* flag_of(const Stop* stop) { return stop == nullptr ? nullptr : stop->flag(); }

// What a frame came to; times in milliseconds.
struct FrameStats {
    int64_t gaussians;  // selected; where the budget is exceeded, what the coarsest cut has
    uint64_t in_frustum, records, entries, items;
    float tolerance_px2;
    bool exceeds_budget;
    double select_ms, draw_ms;
};

FrameStats stats_of(const SceneFrameCounts& c) {
    return {c.gaussians,     c.render.in_frustum, c.render.records,       c.render.entries,    0,
            c.tolerance_px2, c.exceeds_budget,    1e3 * c.select_seconds, 1e3 * c.draw_seconds};
}

// The gaussians of a bundle or an asset as frames of one device read them.
class BoundModel {
  public:
    explicit BoundModel(const Rows& rows) : device_(rows.device()), size_(rows.size()) {
        const GaussianRows<const float> read = rows.read<float>();
        const Work work(device_);
        if (device_.is_host()) {
            const py::gil_scoped_release unlocked;
            host_ = std::make_shared<Model<float>>(read);
            return;
        }
#if V3DG_WITH_CUDA
        rows_ = std::make_unique<Rows>(rows);
        packed_ = std::make_shared<cuda::PackedModel>(read, work.stream());
#endif
    }

    Device device() const { return device_; }
    size_t size() const { return size_; }
    const Model<float>& host() const { return *host_; }
    size_t bytes() const {
        if (host_ != nullptr) return host_->bytes();
#if V3DG_WITH_CUDA
        return packed_->bytes() + size_ * sizeof(float) * (11 + 3 * num_sh_bases(rows_->sh_degree()));
#else
        return 0;
#endif
    }
#if V3DG_WITH_CUDA
    const std::shared_ptr<const cuda::PackedModel>& packed() const { return packed_; }
#endif

  private:
    Device device_;
    size_t size_;
    std::shared_ptr<Model<float>> host_;
#if V3DG_WITH_CUDA
    std::unique_ptr<Rows> rows_;  // which the packed model reads
    std::shared_ptr<const cuda::PackedModel> packed_;
#endif
};

// Colours of the clusters of one bundle on one device.
class BoundPalette {
  public:
    BoundPalette(const py::object& table_object, const py::array& sh, int device)
        : table_(table_object), sh_(sh), device_{device} {
        const auto& table = held<BoundTable>(table_object, "table");
        const auto clusters = static_cast<py::ssize_t>(table.table().num_clusters());
        const Span<const float> colors = span_of<const float>(sh, "sh", {clusters, 3});
        host_ = {colors.data, whole_bundle(table.table()).first_row.data, static_cast<uint32_t>(clusters)};
        const Work work(device_);
#if V3DG_WITH_CUDA
        if (device_.is_host()) return;
        on_device_ = std::make_shared<cuda::DevicePalette>(colors, table.on_device(work), work.stream());
#endif
    }

    Device device() const { return device_; }
    const Palette& host() const { return host_; }
#if V3DG_WITH_CUDA
    const std::shared_ptr<const cuda::DevicePalette>& on_device() const { return on_device_; }
#endif

  private:
    py::object table_;
    py::array sh_;
    Device device_;
    Palette host_;
#if V3DG_WITH_CUDA
    std::shared_ptr<const cuda::DevicePalette> on_device_;
#endif
};

// A scene as the host knows it. It stays as it is: whoever draws it keeps it, and a change makes another.
struct SceneState {
    py::list bundles;
    py::tuple arrays;
    std::vector<ClusterTable> tables;
    std::vector<size_t> num_gaussians;  // of each bundle
    InstanceTable instances;

    const BoundTable& bundle(size_t b) const { return held<BoundTable>(bundles[b], "tables"); }
};

// What selection reads of a scene, on one device.
class BoundScene {
  public:
    explicit BoundScene(int device) : device_{device}, state_(std::make_shared<SceneState>()) {
        const Work work(device_);
#if V3DG_WITH_CUDA
        if (!device_.is_host()) {
            on_device_ = std::make_unique<cuda::SceneTables>();
            cut_ = std::make_unique<cuda::Cut>();
        }
#endif
        set_bundles(py::list());
    }

    Device device() const { return device_; }
    std::shared_ptr<const SceneState> state() const { return state_; }
#if V3DG_WITH_CUDA
    const cuda::SceneTables& on_device() const { return *on_device_; }
#endif

    // Takes the place of all bundles; instances come next.
    void set_bundles(const py::list& bundles) {
        auto state = std::make_shared<SceneState>();
        state->bundles = bundles;
        for (const py::handle& bundle : bundles) {
            const auto& table = held<BoundTable>(bundle, "tables");
            state->tables.push_back(table.table());
            state->num_gaussians.push_back(table.num_gaussians());
        }
#if V3DG_WITH_CUDA
        if (!device_.is_host()) {
            const Work work(device_);
            std::vector<std::shared_ptr<const cuda::BundleTables>> tables;
            for (size_t b = 0; b < state->tables.size(); ++b)
                tables.push_back(state->bundle(b).on_device(work));
            on_device_->set_bundles(std::move(tables), work.stream());
        }
#endif
        state_ = std::move(state);
    }

    void set_instances(const py::array& bundle, const py::array& importance, const py::object& positions,
                       const py::object& quaternions, const py::object& scales) {
        auto state = std::make_shared<SceneState>(*state_);
        InstanceTable& instances = state->instances;
        instances.bundle = span_of<const int32_t>(bundle, "bundle", {-1});
        check_instance_bundles(instances.bundle, state->tables.size());
        const auto count = static_cast<py::ssize_t>(instances.bundle.size);
        instances.importance = span_of<const float>(importance, "importance", {count});
        state->arrays = py::make_tuple(bundle, importance, positions, quaternions, scales);
        if (device_.is_host()) {
            instances.position = span_of<const double>(positions, "positions", {count, 3});
            instances.quaternion = span_of<const double>(quaternions, "quaternions", {count, 4});
            instances.scale = span_of<const double>(scales, "scales", {count});
        }
#if V3DG_WITH_CUDA
        if (!device_.is_host()) {
            const Work work(device_);
            on_device_->set_instances(instances.bundle, instances.importance, work.stream());
        }
#endif
        state_ = std::move(state);
        if (!device_.is_host()) set_poses(positions, quaternions, scales);
    }

    // New poses of the same instances.
    void set_poses(const py::object& positions, const py::object& quaternions, const py::object& scales) {
        if (device_.is_host()) {
            const py::tuple arrays = state_->arrays;
            set_instances(arrays[0], arrays[1], positions, quaternions, scales);
            return;
        }
#if V3DG_WITH_CUDA
        auto state = std::make_shared<SceneState>(*state_);
        const auto count = static_cast<py::ssize_t>(state->instances.bundle.size);
        state->arrays = py::make_tuple(state->arrays[0], state->arrays[1], positions, quaternions, scales);
        const Work work(device_);
        on_device_->set_poses(doubles_anywhere(positions, "positions", {count, 3}),
                              doubles_anywhere(quaternions, "quaternions", {count, 4}),
                              doubles_anywhere(scales, "scales", {count}), work.stream());
        state_ = std::move(state);
#endif
    }

    BoundCut select(const BoundCamera& camera, const SelectRule& rule) {
        const std::shared_ptr<const SceneState> state = state_;
        SelectOutput out;
        const Work work(device_);
        {
            const py::gil_scoped_release unlocked;
            if (device_.is_host())
                cpu::select(
                    {{state->tables.data(), state->tables.size()}, state->instances, camera.camera, rule},
                    out);
#if V3DG_WITH_CUDA
            else
                cut_->select(*on_device_, camera.camera, rule, out, work.stream());
#endif
        }
        return BoundCut(out);
    }

  private:
#if V3DG_WITH_CUDA
    static cuda::PoseSpan doubles_anywhere(const py::handle& array, const char* name, Shape shape) {
        const bool is_host = device_of(array, name).is_host();
        return {is_host ? span_of<const double>(array, name, shape)
                        : device_span_of<const double>(array, name, shape),
                !is_host};
    }
    std::unique_ptr<cuda::SceneTables> on_device_;
    std::unique_ptr<cuda::Cut> cut_;
#endif

    Device device_;
    std::shared_ptr<const SceneState> state_;
};

// A frame that has been drawn, or enqueued on a device, with what it reads and writes.
class BoundDrawing {
  public:
    BoundDrawing(NewPicture picture, const FrameStats& stats) : picture_(std::move(picture)), stats_(stats) {}

#if V3DG_WITH_CUDA
    // `kept` are the frame, which may have to draw again, and what it reads.
    BoundDrawing(NewPicture picture, py::object kept, Device device, std::unique_ptr<cuda::Drawing> drawing)
        : picture_(std::move(picture)),
          kept_(std::move(kept)),
          device_(device),
          drawing_(std::move(drawing)) {}
#endif

    const NewPicture& picture() const { return picture_; }

    const FrameStats& finish() {
#if V3DG_WITH_CUDA
        if (drawing_ != nullptr) {
            const Work work(device_);
            {
                const py::gil_scoped_release unlocked;
                drawing_->wait();
            }
            const cuda::FrameCounters& c = drawing_->finish();  // may draw, and so keeps other threads out
            const cuda::FrameTimes times = drawing_->times();
            const bool exceeds = c.choice.exceeds_budget;
            stats_ = {static_cast<int64_t>(exceeds ? c.choice.least : c.gaussians),
                      c.in_frustum,
                      c.records,
                      c.entries,
                      c.items,
                      c.choice.tolerance_px2,
                      exceeds,
                      times.prepare_ms,
                      times.draw_ms};
        }
#endif
        return stats_;
    }

  private:
    NewPicture picture_;
    FrameStats stats_{};
#if V3DG_WITH_CUDA
    py::object kept_;
    Device device_;
    std::unique_ptr<cuda::Drawing> drawing_;  // gone before what it needs
#endif
};

using Background = std::array<double, 3>;

NewPicture picture_of(const Window& window, bool with_depth) {
    return {window.height(), window.width(), {}, {}, py::none(), with_depth};
}

// Draws scenes of the same bundles on one device.
class BoundSceneFrame {
  public:
    explicit BoundSceneFrame(int device) : device_{device} {
        const Work work(device_);
#if V3DG_WITH_CUDA
        if (!device_.is_host()) frame_ = std::make_unique<cuda::SceneFrame>();
#endif
    }

    // The gaussians of each bundle and, unless there are none, the colours of their clusters.
    void set_models(const py::list& models, const py::list& palettes) {
        if (!palettes.empty() && palettes.size() != models.size())
            throw py::value_error("palettes: expected none, or one for each model");
        std::vector<SceneModel> host;
        std::vector<size_t> num_gaussians;
        for (const py::handle& item : models) {
            const auto& model = held<BoundModel>(item, "models");
            check_device(model.device(), "models");
            num_gaussians.push_back(model.size());
            if (device_.is_host()) host.push_back({&model.host().planes(), {}, {}, {}});
        }
        for (size_t b = 0; b < palettes.size(); ++b) {
            const auto& palette = held<BoundPalette>(palettes[b], "palettes");
            check_device(palette.device(), "palettes");
            if (device_.is_host()) host[b].palette = palette.host();
        }
#if V3DG_WITH_CUDA
        if (!device_.is_host()) set_models_on_device(models, palettes);
#endif
        host_ = std::move(host);
        num_gaussians_ = std::move(num_gaussians);
        models_ = models;
        palettes_ = palettes;
    }

    std::unique_ptr<BoundDrawing> draw(const py::object& scene_object, const BoundCamera& camera,
                                       const SelectRule& rule, const Background& background,
                                       const Stop* stop) {
        auto& scene = checked(scene_object);
        if (device_.is_host())
            return on_host(scene, camera, background, true,
                           [&](const HostScene& host, const Picture<float>& picture) {
                               return cpu::draw_scene(host, camera.camera, rule, picture, flag_of(stop));
                           });
#if V3DG_WITH_CUDA
        const Work work(device_);
        NewPicture picture = picture_of({0, 0, camera.width(), camera.height()}, true);
        const cuda::FrameImage image = picture.on_device(device_, camera.camera, background);
        auto drawing = frame_->draw(scene.on_device(), camera.camera, rule, image, work.stream());
        return std::make_unique<BoundDrawing>(
            std::move(picture), py::make_tuple(py::cast(this), scene_object), device_, std::move(drawing));
#else
        return nullptr;
#endif
    }

    std::unique_ptr<BoundDrawing> draw_cut(const py::object& scene_object, const BoundCamera& camera,
                                           const py::object& instance_ids, const py::object& cluster_ids,
                                           const Background& background, const Stop* stop) {
        auto& scene = checked(scene_object);
        const Span<const int32_t> instance =
            span_on<const int32_t>(device_, instance_ids, "instance_ids", {-1});
        const Span<const int32_t> cluster = span_on<const int32_t>(device_, cluster_ids, "cluster_ids",
                                                                   {static_cast<py::ssize_t>(instance.size)});
        if (device_.is_host())
            return on_host(
                scene, camera, background, true, [&](const HostScene& host, const Picture<float>& picture) {
                    return cpu::draw_cut(host, camera.camera, instance, cluster, picture, flag_of(stop));
                });
#if V3DG_WITH_CUDA
        const Work work(device_);
        NewPicture picture = picture_of({0, 0, camera.width(), camera.height()}, true);
        const cuda::FrameImage image = picture.on_device(device_, camera.camera, background);
        auto drawing =
            frame_->draw_cut(scene.on_device(), camera.camera, instance, cluster, image, work.stream());
        return std::make_unique<BoundDrawing>(
            std::move(picture), py::make_tuple(py::cast(this), scene_object, instance_ids, cluster_ids),
            device_, std::move(drawing));
#else
        return nullptr;
#endif
    }

    // As draw_cut(), with the number of gaussians that each pixel is blended of in place of depth.
    std::unique_ptr<BoundDrawing> count_cut(const py::object& scene_object, const BoundCamera& camera,
                                            const py::array& instance_ids, const py::array& cluster_ids,
                                            const Stop* stop) {
        require_host("count_cut");
        const Span<const int32_t> instance = span_of<const int32_t>(instance_ids, "instance_ids", {-1});
        const Span<const int32_t> cluster =
            span_of<const int32_t>(cluster_ids, "cluster_ids", {static_cast<py::ssize_t>(instance.size)});
        return on_host(checked(scene_object), camera, {0, 0, 0}, true,
                       [&](const HostScene& host, Picture<float> picture) {
                           std::swap(picture.depth, picture.count);
                           return cpu::draw_cut(host, camera.camera, instance, cluster, picture,
                                                flag_of(stop));
                       });
    }

    // (place in the cut, weight, depth), or None.
    py::object pick_cut(const py::object& scene_object, const BoundCamera& camera,
                        const py::array& instance_ids, const py::array& cluster_ids) {
        require_host("pick_cut");
        const std::shared_ptr<const SceneState> state = checked(scene_object).state();
        const Span<const int32_t> instance = span_of<const int32_t>(instance_ids, "instance_ids", {-1});
        const Span<const int32_t> cluster =
            span_of<const int32_t>(cluster_ids, "cluster_ids", {static_cast<py::ssize_t>(instance.size)});
        const std::vector<SceneModel> models = models_of(*state);
        ScenePick picked{};
        bool shows_any = false;
        {
            const py::gil_scoped_release unlocked;
            shows_any = cpu::pick_cut(host_scene(*state, models), camera.camera, instance, cluster, picked);
        }
        if (!shows_any) return py::none();
        return py::make_tuple(picked.pair, picked.weight, picked.depth);
    }

  private:
    BoundScene& checked(const py::object& scene_object) const {
        auto& scene = held<BoundScene>(scene_object, "scene");
        if (scene.device() != device_) throw py::value_error("scene: expected one on the frame's device");
        if (scene.state()->num_gaussians != num_gaussians_)
            throw py::value_error("scene: expected one of the bundles that the frame has the gaussians of");
        return scene;
    }

    void check_device(Device device, const char* name) const {
        if (device != device_)
            throw py::value_error(std::string(name) + ": expected what is on the frame's device, got others");
    }

#if V3DG_WITH_CUDA
    void set_models_on_device(const py::list& models, const py::list& palettes) {
        std::vector<std::shared_ptr<const cuda::PackedModel>> packed;
        for (const py::handle& model : models) packed.push_back(model.cast<const BoundModel&>().packed());
        std::vector<std::shared_ptr<const cuda::DevicePalette>> colors;
        for (const py::handle& palette : palettes)
            colors.push_back(palette.cast<const BoundPalette&>().on_device());
        const Work work(device_);
        frame_->set_models(std::move(packed), std::move(colors), work.stream());
    }
#endif

    void require_host(const char* name) const {
        if (!device_.is_host())
            throw py::value_error(std::string(name) +
                                  ": expected a frame on the CPU, got one on a CUDA device");
    }

    std::vector<SceneModel> models_of(const SceneState& scene) const {
        std::vector<SceneModel> models = host_;
        for (size_t b = 0; b < models.size(); ++b) {
            models[b].pages = whole_bundle(scene.tables[b]);
            models[b].appearance = scene.bundle(b).appearance();
        }
        return models;
    }

    static HostScene host_scene(const SceneState& scene, const std::vector<SceneModel>& models) {
        return {{scene.tables.data(), scene.tables.size()}, {models.data(), models.size()}, scene.instances};
    }

    // The window of the camera, drawn by draw(host scene, picture) without Python's lock.
    template <class DrawPicture>
    std::unique_ptr<BoundDrawing> on_host(const BoundScene& scene, const BoundCamera& camera,
                                          const Background& background, bool with_depth,
                                          const DrawPicture& draw_picture) const {
        const Window window = window_of(camera.camera);
        NewPicture out = picture_of(window, with_depth);
        const Picture<float> picture = out.on_host<float>(window, background);
        const std::shared_ptr<const SceneState> state = scene.state();
        const std::vector<SceneModel> models = models_of(*state);
        const py::list gaussians = models_, colors = palettes_;  // which another thread may replace meanwhile
        SceneFrameCounts counts;
        {
            const py::gil_scoped_release unlocked;
            counts = draw_picture(host_scene(*state, models), picture);
        }
        return std::make_unique<BoundDrawing>(std::move(out), stats_of(counts));
    }

    Device device_;
    py::list models_, palettes_;
    std::vector<size_t> num_gaussians_;  // of each bundle
    std::vector<SceneModel> host_;       // without what the scene knows of the clusters
#if V3DG_WITH_CUDA
    std::unique_ptr<cuda::SceneFrame> frame_;  // on a device
#endif
};

// Draws the gaussians of one asset, which have no levels.
class BoundAssetFrame {
  public:
    explicit BoundAssetFrame(const py::object& model) : model_(model) {
        const Work work(held<BoundModel>(model, "model").device());
#if V3DG_WITH_CUDA
        if (!work.device().is_host()) frame_ = std::make_unique<cuda::ModelFrame>();
#endif
    }

    std::unique_ptr<BoundDrawing> draw(const BoundCamera& camera, const Background& background,
                                       const Stop* stop) {
        const auto& model = held<BoundModel>(model_, "model");
        if (model.device().is_host()) return on_host(model.host(), camera, background, stop);
#if V3DG_WITH_CUDA
        const Device device = model.device();
        const Work work(device);
        NewPicture picture = picture_of({0, 0, camera.width(), camera.height()}, true);
        const cuda::FrameImage image = picture.on_device(device, camera.camera, background);
        const cuda::PackedModel& packed = *model.packed();
        auto drawing = frame_->draw(packed.rows(), view_of_world<float>(camera.camera), 0.0f, false, image,
                                    work.stream(), &packed.packed());
        return std::make_unique<BoundDrawing>(std::move(picture), py::cast(this), device, std::move(drawing));
#else
        return nullptr;
#endif
    }

  private:
    static std::unique_ptr<BoundDrawing> on_host(const Model<float>& model, const BoundCamera& camera,
                                                 const Background& background, const Stop* stop) {
        const Window window = window_of(camera.camera);
        NewPicture out = picture_of(window, true);
        const Picture<float> picture = out.on_host<float>(window, background);
        SceneFrameCounts counts;
        {
            const py::gil_scoped_release unlocked;
            counts = cpu::draw_model(model.planes(), model.size(), camera.camera, picture, flag_of(stop));
        }
        return std::make_unique<BoundDrawing>(std::move(out), stats_of(counts));
    }

    py::object model_;
#if V3DG_WITH_CUDA
    std::unique_ptr<cuda::ModelFrame> frame_;  // on a device
#endif
};

}  // namespace

void bind_scene(py::module_& m) {
    py::class_<Stop>(m, "Stop", "Asks, from any thread, for a picture under way to be given up.")
        .def(py::init<>())
        .def("request", &Stop::request)
        .def_property_readonly("is_requested", &Stop::is_requested);
    py::class_<FrameStats>(m, "FrameStats", "What a frame came to.")
        .def_readonly("gaussians", &FrameStats::gaussians)
        .def_readonly("in_frustum", &FrameStats::in_frustum)
        .def_readonly("records", &FrameStats::records)
        .def_readonly("entries", &FrameStats::entries)
        .def_readonly("items", &FrameStats::items)
        .def_readonly("tolerance_px2", &FrameStats::tolerance_px2)
        .def_readonly("exceeds_budget", &FrameStats::exceeds_budget)
        .def_readonly("select_ms", &FrameStats::select_ms)
        .def_readonly("draw_ms", &FrameStats::draw_ms);
    py::class_<BoundDrawing>(m, "Drawing", "A frame that has been drawn, or enqueued on a device.")
        .def_property_readonly("color", [](const BoundDrawing& d) { return d.picture().color; })
        .def_property_readonly("alpha", [](const BoundDrawing& d) { return d.picture().alpha; })
        .def_property_readonly("depth", [](const BoundDrawing& d) { return d.picture().depth; })
        .def("finish", &BoundDrawing::finish, py::return_value_policy::copy, "Waits for the picture.");
    py::class_<BoundModel>(m, "Model", "Gaussians as frames of their device read them.")
        .def(py::init<const Rows&>(), "gaussians"_a)
        .def("__len__", &BoundModel::size)
        .def_property_readonly("bytes", &BoundModel::bytes);
    py::class_<BoundPalette>(m, "Palette", "Colours of a bundle's clusters, in which gaussians can be drawn.")
        .def(py::init<py::object, py::array, int>(), "table"_a, "sh"_a, "device"_a);
    py::class_<BoundScene>(m, "ResidentScene", "What selection reads of a scene, on one device.")
        .def(py::init<int>(), "device"_a)
        .def("set_bundles", &BoundScene::set_bundles, "tables"_a)
        .def("set_instances", &BoundScene::set_instances, "bundle"_a, "importance"_a, "positions"_a,
             "quaternions"_a, "scales"_a)
        .def("set_poses", &BoundScene::set_poses, "positions"_a, "quaternions"_a, "scales"_a)
        .def("select", &BoundScene::select, "camera"_a, "rule"_a);
    py::class_<BoundSceneFrame>(m, "SceneFrame", "Draws scenes of the same bundles on one device.")
        .def(py::init<int>(), "device"_a)
        .def("set_models", &BoundSceneFrame::set_models, "models"_a, "palettes"_a)
        .def("draw", &BoundSceneFrame::draw, "scene"_a, "camera"_a, "rule"_a, "background"_a,
             "stop"_a = nullptr)
        .def("draw_cut", &BoundSceneFrame::draw_cut, "scene"_a, "camera"_a, "instance_ids"_a, "cluster_ids"_a,
             "background"_a, "stop"_a = nullptr)
        .def("count_cut", &BoundSceneFrame::count_cut, "scene"_a, "camera"_a, "instance_ids"_a,
             "cluster_ids"_a, "stop"_a = nullptr)
        .def("pick_cut", &BoundSceneFrame::pick_cut, "scene"_a, "camera"_a, "instance_ids"_a,
             "cluster_ids"_a);
    py::class_<BoundAssetFrame>(m, "AssetFrame",
                                "Draws gaussians without levels on the device that they are on.")
        .def(py::init<py::object>(), "model"_a)
        .def("draw", &BoundAssetFrame::draw, "camera"_a, "background"_a, "stop"_a = nullptr);
}

}  // namespace v3dg
