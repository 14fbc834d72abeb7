// Frames as Python has them: checks of what they draw, and calls of their backend.

#include <algorithm>
#include <memory>
#include <string>
#include <vector>

#include "bindings/operations.h"
#include "bindings/pool.h"
#include "bindings/resident.h"

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

const std::atomic<bool>* flag_of(const Stop* stop) {
    return stop == nullptr ? nullptr : stop->flag();
}

FrameLook look_of(const std::string& shows) {
    if (shows == "residency") return FrameLook::missing;
    if (shows == "error") return FrameLook::metrics;
    if (shows == "count") return FrameLook::count;
    return FrameLook::appearance;
}

// Colours of the clusters of each bundle: (C, 3) each.
std::vector<const float*> colors_of(const py::list& arrays, const SceneState& scene) {
    std::vector<const float*> colors;
    if (arrays.empty()) return colors;
    for (size_t b = 0; b < scene.tables.size(); ++b) {
        if (b >= arrays.size())
            throw py::value_error("colors: expected none, or of each bundle");
        const auto clusters = static_cast<py::ssize_t>(scene.tables[b].num_clusters());
        colors.push_back(
            span_of<const float>(arrays[b].cast<py::array>(), "colors", {clusters, 3}).data);
    }
    return colors;
}

// Draws scenes of the same bundles, or of the first of them, on one device.
class BoundSceneFrame {
  public:
    explicit BoundSceneFrame(int device) : device_{device} {
        const Work work(device_);
        frame_ = work.backend().make_frame(work);
    }

    // The gaussians of each bundle and, unless there are none, the colours of their clusters.
    void set_models(const py::list& models, const py::list& palettes) {
        if (!palettes.empty() && palettes.size() != models.size())
            throw py::value_error("palettes: expected none, or one for each model");
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

    std::unique_ptr<BoundDrawing> draw(const py::object& scene_object, const BoundEyes& camera,
                                       const SelectRule& rule, const Shade& shade, const Stop* stop,
                                       BudgetSteps* steps) {
        const auto& scene = checked(scene_object);
        const FrameRequest request{.eyes = camera.eyes, .rule = rule, .shade = shade};
        return kept(frame_->draw({.request = request,
                                  .scene = scene.handle(),
                                  .state = scene.state(),
                                  .pool = nullptr,
                                  .steps = steps,
                                  .stop = flag_of(stop)}),
                    scene_object, py::none());
    }

    std::unique_ptr<BoundDrawing> draw_resident(
        const py::object& scene_object, const py::object& pool_object, const BoundEyes& camera,
        const SelectRule& rule, const Shade& shade, const Stop* stop, BudgetSteps* steps,
        const std::string& shows, const py::list& cluster_colors, const BoundEyes* chooser,
        bool is_aside) {
        auto& pool = checked_pool(scene_object, pool_object);
        const auto& scene = held<BoundScene>(scene_object, "scene");
        FrameRequest request{.eyes = camera.eyes, .rule = rule, .shade = shade};
        request.look = look_of(shows);
        request.is_aside = is_aside;
        if (chooser != nullptr) request.chooser = chooser->eyes;
        request.cluster_colors = colors_of(cluster_colors, *scene.state());
        if (backend_of(device_).traits.draws_only_plainly && !request.is_plain())
            throw py::value_error("shows, colors, chooser, aside: expected none on a CUDA device");
        return kept(frame_->draw({.request = request,
                                  .scene = scene.handle(),
                                  .state = scene.state(),
                                  .pool = &pool.handle(),
                                  .steps = steps,
                                  .stop = flag_of(stop)}),
                    scene_object, pool_object);
    }

    // (instance, cluster, weight, depth) of what is resident, or None.
    py::object pick_resident(const py::object& scene_object, const py::object& pool_object,
                             const BoundCamera& camera, const SelectRule& rule) {
        require_host("pick_resident");
        auto& pool = checked_pool(scene_object, pool_object);
        const FrameRequest request{.eyes = camera.camera, .rule = rule, .shade = {}};
        return picked_by(request, held<BoundScene>(scene_object, "scene"), &pool.handle());
    }

    std::unique_ptr<BoundDrawing> draw_cut(const py::object& scene_object,
                                           const BoundCamera& camera,
                                           const py::object& instance_ids,
                                           const py::object& cluster_ids, const Shade& shade,
                                           const Stop* stop, const py::object& weights) {
        return draw_given(scene_object, camera, {}, instance_ids, cluster_ids, shade, stop, weights,
                          FrameLook::appearance);
    }

    // As draw_cut(), with the number of gaussians that each pixel is blended of in place of depth.
    std::unique_ptr<BoundDrawing> count_cut(const py::object& scene_object,
                                            const BoundCamera& camera,
                                            const py::array& instance_ids,
                                            const py::array& cluster_ids, const Shade& shade,
                                            const Stop* stop, const py::object& weights) {
        require_host("count_cut");
        return draw_given(scene_object, camera, {}, instance_ids, cluster_ids, shade, stop, weights,
                          FrameLook::count);
    }

    // As draw_cut(), with the share of the rule's tolerance that each pair's metric takes as its
    // colour.
    std::unique_ptr<BoundDrawing> draw_metrics(const py::object& scene_object,
                                               const BoundCamera& camera, const SelectRule& rule,
                                               const py::array& instance_ids,
                                               const py::array& cluster_ids, const Shade& shade,
                                               const Stop* stop, const py::object& weights) {
        require_host("draw_metrics");
        return draw_given(scene_object, camera, rule, instance_ids, cluster_ids, shade, stop,
                          weights, FrameLook::metrics);
    }

    // Bytes of what it keeps on its device by part, and of the pool that those are of.
    py::dict memory() const {
        py::dict parts;
        const Work work(device_);
        for (const auto& [name, bytes] : frame_->memory()) parts[name] = bytes;
        return parts;
    }

    // (instance, cluster, weight, depth), or None.
    py::object pick_cut(const py::object& scene_object, const BoundCamera& camera,
                        const py::array& instance_ids, const py::array& cluster_ids) {
        require_host("pick_cut");
        const auto& scene = checked(scene_object);
        FrameRequest request{.eyes = camera.camera, .rule = {}, .shade = {}};
        request.cut = given_cut(instance_ids, cluster_ids, py::none());
        return picked_by(request, scene, nullptr);
    }

  private:
    std::unique_ptr<BoundDrawing> draw_given(const py::object& scene_object,
                                             const BoundCamera& camera, const SelectRule& rule,
                                             const py::object& instance_ids,
                                             const py::object& cluster_ids, const Shade& shade,
                                             const Stop* stop, const py::object& weights,
                                             FrameLook look) {
        const auto& scene = checked(scene_object);
        FrameRequest request{.eyes = camera.camera, .rule = rule, .shade = shade, .look = look};
        request.cut = given_cut(instance_ids, cluster_ids, weights);
        return kept(frame_->draw({.request = request,
                                  .scene = scene.handle(),
                                  .state = scene.state(),
                                  .pool = nullptr,
                                  .steps = nullptr,
                                  .stop = flag_of(stop)}),
                    scene_object, py::make_tuple(instance_ids, cluster_ids, weights));
    }

    py::object picked_by(const FrameRequest& request, const BoundScene& scene,
                         backend::Pool* pool) {
        ScenePick picked{};
        const bool shows_any = frame_->pick({.request = request,
                                             .scene = scene.handle(),
                                             .state = scene.state(),
                                             .pool = pool,
                                             .steps = nullptr,
                                             .stop = nullptr},
                                            picked);
        if (!shows_any) return py::none();
        return py::make_tuple(picked.instance, picked.cluster, picked.weight, picked.depth);
    }

    // A drawing that is not done has what it is drawn from.
    std::unique_ptr<BoundDrawing> kept(std::unique_ptr<BoundDrawing> drawing,
                                       const py::object& scene, const py::object& others) const {
        if (drawing->is_under_way()) drawing->keep(py::make_tuple(py::cast(this), scene, others));
        return drawing;
    }

    BoundPool& checked_pool(const py::object& scene_object, const py::object& pool_object) const {
        const auto& scene = held<BoundScene>(scene_object, "scene");
        auto& pool = held<BoundPool>(pool_object, "pool");
        if (scene.device() != device_ || pool.device() != device_)
            throw py::value_error("scene, pool: expected them on the frame's device");
        pool.check_scene(*scene.state());
        return pool;
    }

    // Weights are of 0 to 1, or None where all are 1.
    GivenCut given_cut(const py::handle& instance_ids, const py::handle& cluster_ids,
                       const py::handle& weights) const {
        GivenCut given{span_on<const int32_t>(device_, instance_ids, "instance_ids", {-1}), {}, {}};
        const auto size = static_cast<py::ssize_t>(given.instance.size);
        given.cluster = span_on<const int32_t>(device_, cluster_ids, "cluster_ids", {size});
        if (!weights.is_none())
            given.weight = span_on<const float>(device_, weights, "weights", {size});
        return given;
    }

    const BoundScene& checked(const py::object& scene_object) const {
        const auto& scene = held<BoundScene>(scene_object, "scene");
        if (scene.device() != device_)
            throw py::value_error("scene: expected one on the frame's device");
        const std::vector<size_t>& of_scene = scene.state()->num_gaussians;
        if (of_scene.size() > num_gaussians_.size() ||
            !std::equal(of_scene.begin(), of_scene.end(), num_gaussians_.begin()))
            throw py::value_error(
                "scene: expected one of the bundles that the frame has the gaussians of");
        return scene;
    }

    void check_device(Device device, const char* name) const {
        if (device != device_)
            throw py::value_error(std::string(name) +
                                  ": expected what is on the frame's device, got others");
    }

    void require_host(const char* name) const {
        check_is_on_host(device_, name, "expected a frame on the CPU, got one on a CUDA device");
    }

    Device device_;
    std::vector<size_t> num_gaussians_;  // of each bundle
    std::unique_ptr<backend::Frame> frame_;
};

// Draws the gaussians of one asset, which have no levels.
class BoundAssetFrame {
  public:
    explicit BoundAssetFrame(const py::object& model_object) {
        const auto& model = held<BoundModel>(model_object, "model");
        if (model.has_codes())
            throw py::value_error("model: expected one of rows, got one of codes");
        const Work work(model.device());
        frame_ = work.backend().make_asset_frame(model.handle(), work);
    }

    std::unique_ptr<BoundDrawing> draw(const BoundCamera& camera, const Shade& shade,
                                       const Stop* stop) {
        std::unique_ptr<BoundDrawing> drawing = frame_->draw(camera.camera, shade, flag_of(stop));
        if (drawing->is_under_way()) drawing->keep(py::cast(this));
        return drawing;
    }

  private:
    std::unique_ptr<backend::AssetFrame> frame_;
};

}  // namespace

void bind_frame(py::module_& m) {
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
        .def_readonly("draw_ms", &FrameStats::draw_ms)
        .def_readonly("levels", &FrameStats::levels)
        .def_readonly("num_draws", &FrameStats::num_draws);
    py::class_<Shade>(
        m, "Shade",
        "What is behind a picture, when its pixels stop, and whether their depth is drawn.")
        .def(py::init(
                 [](const std::array<double, 3>& background, float min_transmittance,
                    bool with_depth) { return Shade{background, min_transmittance, with_depth}; }),
             py::kw_only(), "background"_a, "min_transmittance"_a, "with_depth"_a);
    py::class_<NewPicture>(m, "Picture", "The planes of a picture.")
        .def_readonly("color", &NewPicture::color)
        .def_readonly("alpha", &NewPicture::alpha)
        .def_readonly("depth", &NewPicture::depth);
    py::class_<BoundDrawing>(m, "Drawing", "A frame that has been drawn, or enqueued on a device.")
        .def_property_readonly("color", [](const BoundDrawing& d) { return d.picture().color; })
        .def_property_readonly("alpha", [](const BoundDrawing& d) { return d.picture().alpha; })
        .def_property_readonly("depth", [](const BoundDrawing& d) { return d.picture().depth; })
        .def_property_readonly("right", &BoundDrawing::right,
                               "Of two eyes: what the right one sees.")
        .def("finish", &BoundDrawing::finish, py::return_value_policy::copy,
             "Waits for the picture.");
    py::class_<BoundSceneFrame>(m, "SceneFrame", "Draws scenes of the same bundles on one device.")
        .def(py::init<int>(), "device"_a)
        .def("set_models", &BoundSceneFrame::set_models, "models"_a, "palettes"_a)
        .def("draw", &BoundSceneFrame::draw, "scene"_a, "camera"_a, "rule"_a, "shade"_a,
             "stop"_a = nullptr, "steps"_a = nullptr)
        .def("draw_resident", &BoundSceneFrame::draw_resident, "scene"_a, "pool"_a, "camera"_a,
             "rule"_a, "shade"_a, "stop"_a = nullptr, "steps"_a = nullptr, py::kw_only(),
             "shows"_a = "appearance", "colors"_a = py::list(), "chooser"_a = nullptr,
             "aside"_a = false)
        .def("pick_resident", &BoundSceneFrame::pick_resident, "scene"_a, "pool"_a, "camera"_a,
             "rule"_a)
        .def("draw_cut", &BoundSceneFrame::draw_cut, "scene"_a, "camera"_a, "instance_ids"_a,
             "cluster_ids"_a, "shade"_a, "stop"_a = nullptr, "weights"_a = py::none())
        .def("count_cut", &BoundSceneFrame::count_cut, "scene"_a, "camera"_a, "instance_ids"_a,
             "cluster_ids"_a, "shade"_a, "stop"_a = nullptr, "weights"_a = py::none())
        .def("draw_metrics", &BoundSceneFrame::draw_metrics, "scene"_a, "camera"_a, "rule"_a,
             "instance_ids"_a, "cluster_ids"_a, "shade"_a, "stop"_a = nullptr,
             "weights"_a = py::none())
        .def("memory", &BoundSceneFrame::memory,
             "Bytes that it keeps on a CUDA device, by part; and those of the pool of all frames "
             "there.")
        .def("pick_cut", &BoundSceneFrame::pick_cut, "scene"_a, "camera"_a, "instance_ids"_a,
             "cluster_ids"_a);
    py::class_<BoundAssetFrame>(m, "AssetFrame",
                                "Draws gaussians without levels on the device that they are on.")
        .def(py::init<py::object>(), "model"_a)
        .def("draw", &BoundAssetFrame::draw, "camera"_a, "shade"_a, "stop"_a = nullptr);
}

}  // namespace v3dg
