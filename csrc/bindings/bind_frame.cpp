// Bindings of frames: they check the inputs and call the backend.

#include <algorithm>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "bindings/operations.h"
#include "bindings/pool.h"
#include "bindings/resident.h"

namespace v3dg {

namespace {

// A flag that requests work in progress to end early. Any thread may set it.
class Stop {
  public:
    void request() { requested_.store(true, std::memory_order_relaxed); }
    bool is_requested() const { return requested_.load(std::memory_order_relaxed); }
    const std::atomic<bool>* flag() const { return &requested_; }

  private:
    std::atomic<bool> requested_{false};
};

const std::atomic<bool>* flag_of(const Stop* stop) {
    return stop == nullptr ? nullptr : stop->flag();
}

FrameLook look_of(const std::string& shows) {
    if (shows == "residency") return FrameLook::missing;
    if (shows == "error") return FrameLook::metrics;
    if (shows == "count") return FrameLook::count;
    return FrameLook::appearance;
}

Eyes eyes_of(const py::object& camera) {
    if (py::isinstance<BoundCamera>(camera)) return camera.cast<const BoundCamera&>().camera;
    if (!py::isinstance<BoundEyes>(camera)) refuse_kind("camera", "a Camera or Eyes", camera);
    return camera.cast<const BoundEyes&>().eyes;
}

// A cut that was selected earlier. The arrays must be on the frame's device, which is
// checked when the frame draws.
struct BoundGivenCut {
    py::object instance_ids, cluster_ids, weights;

    // Borrows the arrays. Weights are from 0 to 1, or None if all are 1.
    GivenCut read(Device device) const {
        GivenCut given{span_on<const int32_t>(device, instance_ids, "instance_ids", {-1}), {}, {}};
        const auto size = static_cast<py::ssize_t>(given.instance.size);
        given.cluster = span_on<const int32_t>(device, cluster_ids, "cluster_ids", {size});
        if (!weights.is_none())
            given.weight = span_on<const float>(device, weights, "weights", {size});
        return given;
    }
};

// The optional parts of a request: false colours, and another camera for the cut.
struct BoundLook {
    FrameLook look = FrameLook::appearance;
    py::list cluster_colors;  // (C, 3) colours for each bundle, or empty
    std::optional<Eyes> chooser;
    bool is_aside = false;
};

// Throws ValueError if the channel `clipped` is requested for a camera that is not a
// pinhole camera.
void check_clipped(const SensorRequest& request, const Camera& camera) {
    if (request.channels.clipped && !camera.is_pinhole())
        throw py::value_error(
            "channels: 'clipped' needs a pinhole camera, got a camera with another lens; leave "
            "'clipped' out");
}

// Returns the request for channels and meshes in pictures of these eyes. `sensor` is a
// BoundSensor or None.
SensorRequest sensor_of(const py::object& sensor, const Eyes& eyes) {
    if (sensor.is_none()) return {};
    const Window window = window_of(eyes.camera[0]);
    std::vector<py::ssize_t> shape{window.height(), window.width()};
    if (eyes.are_two) shape.insert(shape.begin(), 2);
    const SensorRequest request = held<BoundSensor>(sensor, "sensor").request(shape);
    check_clipped(request, eyes.camera[0]);
    return request;
}

// A request. The given cut and the colours of clusters are separate, because only a
// frame can check them.
struct BoundRequest {
    FrameRequest plain;
    std::optional<BoundGivenCut> cut;
    py::object cluster_colors;  // as in BoundLook; null if there is none
    py::object sensor;          // BoundSensor or None; owns the arrays of the mesh

    // `camera` is a Camera or an Eyes, which the constructor tests. Overloads or
    // implicit conversions would take most of the constructor's time.
    BoundRequest(const py::object& camera, const SelectRule* rule, const Shade* shade,
                 const BoundGivenCut* given, const BoundLook* look, py::object channels)
        : plain{.eyes = eyes_of(camera),
                .rule = rule == nullptr ? SelectRule{} : *rule,
                .shade = shade == nullptr ? Shade{} : *shade},
          cluster_colors(look == nullptr ? py::object() : py::object(look->cluster_colors)),
          sensor(std::move(channels)) {
        check_footprint(plain.eyes, plain.rule);
        plain.sensor = sensor_of(sensor, plain.eyes);
        if (given != nullptr && plain.eyes.are_two)
            throw py::value_error(
                "cut: expected one camera, got two eyes; draw each eye separately");
        if (given != nullptr) cut = *given;
        if (look == nullptr) return;
        plain.look = look->look;
        plain.is_aside = look->is_aside;
        plain.chooser = look->chooser;
    }

    bool has_colors() const { return cluster_colors && py::len(cluster_colors) > 0; }
    bool is_complete() const { return !cut && !has_colors(); }
    FrameRequest completed(Device device, const SceneState& scene) const {
        FrameRequest request = plain;
        if (cut) request.cut = cut->read(device);
        if (!has_colors()) return request;
        const py::list arrays(cluster_colors);
        for (size_t b = 0; b < scene.tables.size(); ++b) {
            if (b >= arrays.size())
                throw py::value_error("colors: expected none, or one array for each of " +
                                      std::to_string(scene.tables.size()) + " bundles, got " +
                                      std::to_string(arrays.size()));
            const auto clusters = static_cast<py::ssize_t>(scene.tables[b].num_clusters());
            const auto colors = arrays[b].cast<py::array>();
            request.cluster_colors.push_back(
                span_of<const float>(colors, "colors", {clusters, 3}).data);
        }
        return request;
    }
};

// Throws ValueError if the mesh is on another device. `sensor` is a BoundSensor or
// None.
void check_sensor(Device device, const py::object& sensor) {
    if (!sensor.is_none()) held<BoundSensor>(sensor, "sensor").check_device(device);
}

// Draws scenes on one device. The frame's models belong to the bundles of the scenes,
// in order. A scene may have fewer bundles.
class BoundSceneFrame {
  public:
    explicit BoundSceneFrame(int device) : device_{device} {
        const Work work(device_);
        frame_ = work.backend().make_frame(work);
    }

    // Sets the gaussians of each bundle and, unless `palettes` is empty, the colours of
    // their clusters.
    void set_models(const py::list& models, const py::list& palettes) {
        if (!palettes.empty() && palettes.size() != models.size())
            throw py::value_error("palettes: expected none, or one for each of " +
                                  std::to_string(models.size()) + " models, got " +
                                  std::to_string(palettes.size()));
        std::vector<std::shared_ptr<const backend::Model>> model_handles;
        std::vector<std::shared_ptr<const backend::Palette>> palette_handles;
        std::vector<size_t> num_gaussians;
        for (const py::handle& item : models) {
            const auto& model = held<BoundModel>(item, "models");
            check_device(model.device(), "models");
            num_gaussians.push_back(model.size());
            model_handles.push_back(model.handle());
        }
        for (const py::handle& item : palettes) {
            const auto& palette = held<BoundPalette>(item, "palettes");
            check_device(palette.device(), "palettes");
            palette_handles.push_back(palette.handle());
        }
        const Work work(device_);
        frame_->set_models(std::move(model_handles), std::move(palette_handles), work);
        num_gaussians_ = std::move(num_gaussians);
    }

    // Draws the models that were set. With a pool, first brings in pages that are
    // ready, and then draws the resident part of the pool. `steps` is the state of a
    // sequence of pictures, or null for a single picture.
    std::unique_ptr<BoundDrawing> draw(const py::object& scene_object,
                                       const py::object& request_object,
                                       const py::object& pool_object, BudgetSteps* steps,
                                       const Stop* stop) {
        std::unique_ptr<BoundDrawing> drawing;
        with_input(scene_object, request_object, pool_object, [&](backend::FrameInput input) {
            input.steps = steps;
            input.stop = flag_of(stop);
            drawing = frame_->draw(input);
        });
        // An unfinished drawing keeps its inputs alive.
        if (drawing->is_under_way())
            drawing->keep(
                py::make_tuple(py::cast(this), scene_object, request_object, pool_object));
        return drawing;
    }

    // Draws a picture for each camera with the models that were set. The planes belong
    // to the caller, or are new.
    std::unique_ptr<BoundBatch> draw_batch(const py::object& scene_object,
                                           const py::object& cameras_object, const SelectRule& rule,
                                           const Shade& shade, const BoundPlanes* planes,
                                           const py::object& sensor_object) {
        const BoundScene& scene = checked(scene_object);
        const auto& cameras = held<BoundCameras>(cameras_object, "cameras");
        if (cameras.device() != device_)
            throw py::value_error("cameras: expected arrays on the frame's device");
        if (rule.budget != kNoBudget)
            throw py::value_error(
                "budget: a batch has no budget; leave it out, or draw the cameras one by one");
        const std::shared_ptr<const SceneState> state = scene.state();
        check_environments(device_, cameras.environments(), cameras.size(),
                           state->environments->table(), "environments");
        std::optional<BoundPlanes> new_planes;
        if (planes == nullptr) planes = &new_planes.emplace(cameras, device_, shade.with_depth);
        planes->check(cameras, device_);
        NewChannels channels = planes->channels();
        const Sensor sensor =
            sensor_of_batch(sensor_object, cameras, planes->sensor_planes(), channels);
        const BatchRequest request{.rule = rule,
                                   .shade = shade,
                                   .width = cameras.width(),
                                   .height = cameras.height(),
                                   .planes = planes->planes(),
                                   .sensor = sensor};
        std::unique_ptr<BoundBatch> batch = frame_->draw_batch(
            {.request = request, .cameras = cameras, .scene = scene.handle(), .state = state});
        batch->keep(py::make_tuple(py::cast(this), scene_object, cameras_object, sensor_object),
                    *planes);
        batch->channels = channels;
        return batch;
    }

    // Returns the gaussian with the largest blend weight in the first pixel of the
    // window, or None.
    std::optional<ScenePick> pick(const py::object& scene_object, const py::object& request_object,
                                  const py::object& pool_object) {
        check_is_on_host(device_, "pick", "expected a frame on the CPU, got one on a CUDA device");
        ScenePick picked{};
        bool shows_any = false;
        with_input(
            scene_object, request_object, pool_object,
            [&](const backend::FrameInput& input) { shows_any = frame_->pick(input, picked); });
        if (!shows_any) return {};
        return picked;
    }

    // Returns the device memory of the frame in bytes, one entry per purpose, and the
    // bytes of the memory pool.
    py::dict memory() const {
        py::dict parts;
        const Work work(device_);
        for (const auto& [name, bytes] : frame_->memory()) parts[name] = bytes;
        return parts;
    }

  private:
    // Returns the meshes and the planes for the channels of a batch. Channels that the
    // caller has planes for are drawn to these planes, and other requested channels to
    // new ones.
    Sensor sensor_of_batch(const py::object& sensor, const BoundCameras& cameras,
                           const SensorPlanes& planes, NewChannels& channels) const {
        if (sensor.is_none()) return {.planes = planes, .mesh = {}};
        check_sensor(device_, sensor);
        const std::vector<py::ssize_t> shape{static_cast<py::ssize_t>(cameras.size()),
                                             cameras.height(), cameras.width()};
        const SensorRequest request = held<BoundSensor>(sensor, "sensor").request(shape);
        for (const Camera& camera : cameras.lenses()) check_clipped(request, camera);
        return {.planes = channels.allocate(device_, request.channels, shape, planes),
                .mesh = request.mesh};
    }

    // Checks that the scene, the request and the pool fit each other, then calls
    // body(input).
    template <class Body>
    void with_input(const py::object& scene_object, const py::object& request_object,
                    const py::object& pool_object, const Body& body) const {
        const bool has_pool = !pool_object.is_none();
        BoundPool* const pool = has_pool ? &checked_pool(scene_object, pool_object) : nullptr;
        const BoundScene& scene =
            has_pool ? held<BoundScene>(scene_object, "scene") : checked(scene_object);
        const auto& bound = held<BoundRequest>(request_object, "request");
        const std::shared_ptr<const SceneState> state = scene.state();
        std::optional<FrameRequest> completed;
        if (!bound.is_complete()) completed = bound.completed(device_, *state);
        const FrameRequest& request = completed ? *completed : bound.plain;
        if (has_pool && request.cut)
            throw py::value_error("cut: a pool selects its own cut; leave out `cut`");
        check_sensor(device_, bound.sensor);
        if (backend_of(device_).traits.draws_only_plainly && !request.is_plain())
            throw py::value_error(
                "shows, colors, chooser, aside: these are supported only on the CPU; leave "
                "them out on a CUDA device");
        body(backend::FrameInput{.request = request,
                                 .scene = scene.handle(),
                                 .state = state,
                                 .pool = has_pool ? &pool->handle() : nullptr,
                                 .steps = nullptr,
                                 .stop = nullptr});
    }

    BoundPool& checked_pool(const py::object& scene_object, const py::object& pool_object) const {
        const auto& scene = held<BoundScene>(scene_object, "scene");
        auto& pool = held<BoundPool>(pool_object, "pool");
        if (scene.device() != device_ || pool.device() != device_)
            throw py::value_error(
                "scene, pool: expected both on the frame's device, got another device");
        pool.check_scene(*scene.state());
        return pool;
    }

    const BoundScene& checked(const py::object& scene_object) const {
        const auto& scene = held<BoundScene>(scene_object, "scene");
        if (scene.device() != device_)
            throw py::value_error(
                "scene: expected a scene on the frame's device, got one on another device");
        const std::vector<size_t>& of_scene = scene.state()->num_gaussians;
        if (of_scene.size() > num_gaussians_.size() ||
            !std::equal(of_scene.begin(), of_scene.end(), num_gaussians_.begin()))
            throw py::value_error(
                "scene: expected a scene of the bundles that the frame draws, got other bundles");
        return scene;
    }

    void check_device(Device device, const char* name) const {
        if (device != device_)
            throw py::value_error(
                std::string(name) +
                ": expected objects on the frame's device, got some on another device");
    }

    Device device_;
    std::vector<size_t> num_gaussians_;  // number of gaussians of each bundle
    std::unique_ptr<backend::Frame> frame_;
};

// Draws the gaussians of one asset, which has no levels.
class BoundAssetFrame {
  public:
    BoundAssetFrame(const py::object& model_object, float filter_px2, bool antialiased) {
        const auto& model = held<BoundModel>(model_object, "model");
        if (model.has_codes())
            throw py::value_error("model: expected float32 gaussians, got quantized ones");
        device_ = model.device();
        const Work work(device_);
        const Appearance<float> appearance{filter_px2, antialiased, false};
        frame_ = work.backend().make_asset_frame(model.handle(), appearance, work);
    }

    std::unique_ptr<BoundDrawing> draw(const BoundCamera& camera, const Shade& shade,
                                       const Stop* stop, const py::object& sensor_object) {
        const SensorRequest sensor = sensor_of(sensor_object, camera.camera);
        check_sensor(device_, sensor_object);
        std::unique_ptr<BoundDrawing> drawing =
            frame_->draw(camera.camera, shade, sensor, flag_of(stop));
        if (drawing->is_under_way()) drawing->keep(py::make_tuple(py::cast(this), sensor_object));
        return drawing;
    }

  private:
    Device device_;
    std::unique_ptr<backend::AssetFrame> frame_;
};

}  // namespace

void bind_frame(py::module_& m) {
    py::class_<Stop>(m, "Stop",
                     "A flag that asks work in progress to end early. Any thread may "
                     "set it.")
        .def(py::init<>())
        .def("request", &Stop::request)
        .def_property_readonly("is_requested", &Stop::is_requested);
    py::class_<FrameStats>(m, "FrameStats", "The statistics of a frame.")
        .def_readonly("gaussians", &FrameStats::gaussians)
        .def_readonly("in_frustum", &FrameStats::in_frustum)
        .def_readonly("records", &FrameStats::records)
        .def_readonly("entries", &FrameStats::entries)
        .def_readonly("items", &FrameStats::items)
        .def_readonly("tolerance_px2", &FrameStats::tolerance_px2)
        .def_readonly("exceeds_budget", &FrameStats::exceeds_budget)
        .def_readonly("select_ms", &FrameStats::select_ms)
        .def_readonly("draw_ms", &FrameStats::draw_ms)
        .def_readonly("levels", &FrameStats::levels)
        .def_readonly("num_draws", &FrameStats::num_draws);
    m.def("stop_of_tolerance", &stop_of_tolerance, "tolerance_px2"_a,
          "The transmittance behind which pixels of a cut stop.");
    py::class_<Shade>(m, "Shade",
                      "The background of a picture, the transmittance at which pixels stop, and "
                      "whether depth is drawn.")
        .def(py::init(
                 [](const std::array<double, 3>& background, float min_transmittance,
                    bool with_depth) { return Shade{background, min_transmittance, with_depth}; }),
             py::kw_only(), "background"_a, "min_transmittance"_a, "with_depth"_a)
        .def_readonly("background", &Shade::background)
        .def_readonly("min_transmittance", &Shade::min_transmittance)
        .def_readonly("with_depth", &Shade::with_depth);
    py::class_<NewPicture>(m, "Picture", "A drawn picture: arrays of colour, alpha and depth.")
        .def_readonly("color", &NewPicture::color)
        .def_readonly("alpha", &NewPicture::alpha)
        .def_readonly("depth", &NewPicture::depth)
        .def_readonly("channels", &NewPicture::channels);
    py::class_<BoundDrawing>(m, "Drawing", "A frame that has been drawn, or enqueued on a device.")
        .def_property_readonly("color", [](const BoundDrawing& d) { return d.picture().color; })
        .def_property_readonly("alpha", [](const BoundDrawing& d) { return d.picture().alpha; })
        .def_property_readonly("depth", [](const BoundDrawing& d) { return d.picture().depth; })
        .def_property_readonly("channels",
                               [](const BoundDrawing& d) { return d.picture().channels; })
        .def_property_readonly("right", &BoundDrawing::right,
                               "The picture of the right eye, if there are two eyes.")
        .def("finish", &BoundDrawing::finish, py::return_value_policy::copy,
             "Waits until the pictures are drawn, and returns the statistics.");
    py::class_<BoundGivenCut>(m, "GivenCut", "A cut that was selected earlier; borrows the arrays.")
        .def(py::init([](const py::object& instance_ids, const py::object& cluster_ids,
                         const py::object& weights) {
                 return BoundGivenCut{
                     .instance_ids = instance_ids, .cluster_ids = cluster_ids, .weights = weights};
             }),
             "instance_ids"_a, "cluster_ids"_a, "weights"_a = py::none());
    py::class_<BoundLook>(
        m, "Look", "Optional parts of a request: false colours, and another camera for the cut.")
        .def(py::init([](const std::string& shows, const py::list& colors, const BoundEyes* chooser,
                         bool aside) {
                 BoundLook look{.look = look_of(shows), .cluster_colors = colors, .chooser = {}};
                 if (chooser != nullptr) look.chooser = chooser->eyes;
                 look.is_aside = aside;
                 return look;
             }),
             "shows"_a = "appearance", "colors"_a = py::list(), "chooser"_a = nullptr,
             "aside"_a = false);
    py::class_<BoundRequest>(m, "FrameRequest", "The request for one picture.")
        .def(py::init<const py::object&, const SelectRule*, const Shade*, const BoundGivenCut*,
                      const BoundLook*, py::object>(),
             "camera"_a, "rule"_a = nullptr, "shade"_a = nullptr, "cut"_a = nullptr,
             "look"_a = nullptr, "sensor"_a = py::none());
    py::class_<ScenePick>(m, "Pick", "The gaussian with the largest blend weight in a pixel.")
        .def_readonly("instance", &ScenePick::instance)
        .def_readonly("cluster", &ScenePick::cluster)
        .def_readonly("weight", &ScenePick::weight)
        .def_readonly("depth", &ScenePick::depth);
    py::class_<BoundSceneFrame>(m, "SceneFrame", "Draws scenes of the same bundles on one device.")
        .def(py::init<int>(), "device"_a)
        .def("set_models", &BoundSceneFrame::set_models, "models"_a, "palettes"_a)
        .def("draw", &BoundSceneFrame::draw, "scene"_a, "request"_a, "pool"_a = py::none(),
             "steps"_a = nullptr, "stop"_a = nullptr)
        .def("draw_batch", &BoundSceneFrame::draw_batch, "scene"_a, "cameras"_a, "rule"_a,
             "shade"_a, "planes"_a = nullptr, "sensor"_a = py::none())
        .def("pick", &BoundSceneFrame::pick, "scene"_a, "request"_a, "pool"_a = py::none())
        .def("memory", &BoundSceneFrame::memory,
             "Returns the bytes of the frame on a CUDA device, by part, and the bytes of the "
             "memory pool that all frames on the device share.");
    py::class_<BoundAssetFrame>(m, "AssetFrame", "Draws gaussians without levels on their device.")
        .def(py::init<py::object, float, bool>(), "model"_a, py::kw_only(), "filter_px2"_a = 0.0f,
             "antialiased"_a = false)
        .def("draw", &BoundAssetFrame::draw, "camera"_a, "shade"_a, "stop"_a = nullptr,
             "sensor"_a = py::none());
}

}  // namespace v3dg
