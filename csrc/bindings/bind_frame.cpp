#include <algorithm>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "bindings/drawing.h"
#include "bindings/operations.h"
#include "bindings/pool.h"
#include "bindings/resident.h"
#include "draw/scene_frame.h"

namespace v3dg {

namespace {

// What a picture from a pool shows: colours, and where clusters have their own, those; or how many
// gaussians each pixel is blended of, in place of depth.
struct PoolLook {
    SceneColors colors = SceneColors::own;
    bool counts = false;
    bool is_aside = false;
    std::optional<Eyes> chooser;
    py::list cluster_colors;

    bool is_plain() const {
        return colors == SceneColors::own && !counts && !is_aside && !chooser &&
               cluster_colors.empty();
    }
};

PoolLook pool_look(const std::string& shows, const py::list& cluster_colors,
                   const BoundEyes* chooser, bool is_aside) {
    PoolLook look;
    if (shows == "residency") look.colors = SceneColors::missing;
    if (shows == "error") look.colors = SceneColors::metrics;
    look.counts = shows == "count";
    look.is_aside = is_aside;
    if (chooser != nullptr) look.chooser = chooser->eyes;
    look.cluster_colors = cluster_colors;
    return look;
}

#if V3DG_WITH_CUDA
// Pictures of the eyes on the device, which have no memory yet.
cuda::EyeImages new_images(const Eyes& eyes, const Shade& shade, NewPictures& pictures) {
    cuda::FrameImage image[2]{};
    for (int k = 0; k < eyes.count(); ++k) {
        const Camera& eye = eyes.camera[k];
        const Window whole{0, 0, static_cast<int>(eye.width), static_cast<int>(eye.height)};
        pictures.push_back(picture_of(whole, shade.with_depth));
        image[k] = pictures.back().frame_image(eye, shade);
    }
    const float stop = shade.min_transmittance;
    return eyes.are_two ? cuda::images_of_eyes(image[0], image[1], stop)
                        : cuda::EyeImages{{image[0], {}}, 1, stop};
}

// Gives them their memory, for which torch takes a while.
cuda::Frame::Place place_of(NewPictures& pictures, Device device) {
    return [&pictures, device](cuda::PicturePlanes planes[2]) {
        for (size_t k = 0; k < pictures.size(); ++k) planes[k] = pictures[k].on_device(device);
    };
}
#endif

// Draws scenes of the same bundles, or of the first of them, on one device.
class BoundSceneFrame {
  public:
    explicit BoundSceneFrame(int device) : device_{device} {
        const Work work(device_);
#if V3DG_WITH_CUDA
        if (device_.is_host()) return;
        frame_ = std::make_unique<cuda::SceneFrame>();
        turns_ = std::make_shared<std::mutex>();
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
            if (device_.is_host()) host.push_back(model.on_host());
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

    // With `steps`, of pictures that follow each other.
    std::unique_ptr<BoundDrawing> draw(const py::object& scene_object, const BoundEyes& camera,
                                       const SelectRule& rule, const Shade& shade, const Stop* stop,
                                       BudgetSteps* steps) {
        const Turn turn(turns_.get());
        auto& scene = checked(scene_object);
        const Eyes& eyes = camera.eyes;
        const auto draw_paced = [&](const SelectRule& paced,
                                    uint32_t* last_bin) -> std::unique_ptr<BoundDrawing> {
            if (device_.is_host())
                return on_host(scene, eyes, shade,
                               [&](HostScene host, Span<const Picture<float>> out) {
                                   host.last_bin = last_bin;
                                   return cpu::draw_scene(host, eyes, paced, out, flag_of(stop));
                               });
#if V3DG_WITH_CUDA
            const Work work(device_);
            NewPictures pictures;
            const cuda::EyeImages images = new_images(eyes, shade, pictures);
            auto drawing = frame_->draw(scene.on_device(), eyes, paced, images, work.stream(),
                                        place_of(pictures, device_));
            return std::make_unique<BoundDrawing>(std::move(pictures),
                                                  py::make_tuple(py::cast(this), scene_object),
                                                  device_, turns_, std::move(drawing), rule);
#else
            return nullptr;
#endif
        };
        return in_steps(steps, rule, eyes, scene.state(), draw_paced);
    }

    // What is resident of the bundles of a pool, with what comes in before.
    std::unique_ptr<BoundDrawing> draw_resident(const py::object& scene_object,
                                                const py::object& pool_object,
                                                const BoundEyes& camera, const SelectRule& rule,
                                                const Shade& shade, const Stop* stop,
                                                BudgetSteps* steps, const std::string& shows,
                                                const py::list& cluster_colors,
                                                const BoundEyes* chooser, bool is_aside) {
        const PoolLook look = pool_look(shows, cluster_colors, chooser, is_aside);
        auto& pool = checked_pool(scene_object, pool_object);
        const auto& scene = held<BoundScene>(scene_object, "scene");
        const std::shared_ptr<const SceneState> state = scene.state();
        const Turn turn(turns_.get());
        const Eyes& eyes = camera.eyes;
        if (!device_.is_host() && !look.is_plain())
            throw py::value_error("shows, colors, chooser, aside: expected none on a CUDA device");
        const auto draw_paced = [&](const SelectRule& paced,
                                    uint32_t* last_bin) -> std::unique_ptr<BoundDrawing> {
            if (device_.is_host()) {
                const float wanted = rule.tolerance_px2;
                return resident_on_host(*state, pool, eyes, paced, wanted, shade, stop, look,
                                        last_bin);
            }
#if V3DG_WITH_CUDA
            const Work work(device_);
            NewPictures pictures;
            const cuda::EyeImages images = new_images(eyes, shade, pictures);
            SelectRule used = paced;
            auto drawing =
                frame_->draw_resident(scene.on_device(), pool.on_device(), eyes, used, images,
                                      work.stream(), place_of(pictures, device_));
            return std::make_unique<BoundDrawing>(
                std::move(pictures), py::make_tuple(py::cast(this), scene_object, pool_object),
                device_, turns_, std::move(drawing), used, &pool.on_device());
#else
            return nullptr;
#endif
        };
        return in_steps(steps, rule, look.chooser ? *look.chooser : eyes, state, draw_paced);
    }

    // (instance, cluster, weight, depth) of what is resident, or None.
    py::object pick_resident(const py::object& scene_object, const py::object& pool_object,
                             const BoundCamera& camera, const SelectRule& rule) {
        require_host("pick_resident");
        auto& pool = checked_pool(scene_object, pool_object);
        const auto state = held<BoundScene>(scene_object, "scene").state();
        const std::vector<SceneModel> models = models_in(pool, *state, py::list());
        const Eyes eyes = camera.camera;
        SelectOutput cut;
        ScenePick picked{};
        bool shows_any = false;
        {
            const Unlocked unlocked;
            pool.frame_on_host(
                *state, rule, PoolFrame::aside,
                [&](auto tables, const SelectRule& raised, auto needs) {
                    const HostScene host{tables, {models.data(), models.size()}, state->instances};
                    cpu::select({tables, state->instances, eyes, raised, needs}, cut);
                    const GivenCut given{{cut.instance.data(), cut.instance.size()},
                                         {cut.cluster.data(), cut.cluster.size()},
                                         {cut.weight.data(), cut.weight.size()}};
                    shows_any = cpu::pick_cut(host, camera.camera, given, picked);
                    return raised.tolerance_px2;
                });
        }
        if (!shows_any) return py::none();
        return py::make_tuple(cut.instance[picked.pair], cut.cluster[picked.pair], picked.weight,
                              picked.depth);
    }

    std::unique_ptr<BoundDrawing> draw_cut(const py::object& scene_object,
                                           const BoundCamera& camera,
                                           const py::object& instance_ids,
                                           const py::object& cluster_ids, const Shade& shade,
                                           const Stop* stop, const py::object& weights) {
        auto& scene = checked(scene_object);
        const GivenCut given = given_cut(instance_ids, cluster_ids, weights);
        if (device_.is_host())
            return on_host(scene, camera.camera, shade,
                           [&](const HostScene& host, Span<const Picture<float>> out) {
                               return cpu::draw_cut(host, camera.camera, given, out[0],
                                                    flag_of(stop));
                           });
#if V3DG_WITH_CUDA
        const Turn turn(turns_.get());
        const Work work(device_);
        NewPictures pictures;
        const cuda::EyeImages images = new_images(camera.camera, shade, pictures);
        auto drawing = frame_->draw_cut(scene.on_device(), camera.camera, given, images,
                                        work.stream(), place_of(pictures, device_));
        return std::make_unique<BoundDrawing>(
            std::move(pictures),
            py::make_tuple(py::cast(this), scene_object, instance_ids, cluster_ids, weights),
            device_, turns_, std::move(drawing), SelectRule{});
#else
        return nullptr;
#endif
    }

    // As draw_cut(), with the number of gaussians that each pixel is blended of in place of depth.
    std::unique_ptr<BoundDrawing> count_cut(const py::object& scene_object,
                                            const BoundCamera& camera,
                                            const py::array& instance_ids,
                                            const py::array& cluster_ids, Shade shade,
                                            const Stop* stop, const py::object& weights) {
        require_host("count_cut");
        const GivenCut given = given_cut(instance_ids, cluster_ids, weights);
        shade.with_depth = true;
        return on_host(checked(scene_object), camera.camera, shade,
                       [&](const HostScene& host, Span<const Picture<float>> out) {
                           Picture<float> picture = out[0];
                           std::swap(picture.depth, picture.count);
                           return cpu::draw_cut(host, camera.camera, given, picture, flag_of(stop));
                       });
    }

    // As draw_cut(), with the share of the rule's tolerance that each pair's metric takes as its
    // colour.
    std::unique_ptr<BoundDrawing> draw_metrics(const py::object& scene_object,
                                               const BoundCamera& camera, const SelectRule& rule,
                                               const py::array& instance_ids,
                                               const py::array& cluster_ids, const Shade& shade,
                                               const Stop* stop, const py::object& weights) {
        require_host("draw_metrics");
        const GivenCut given = given_cut(instance_ids, cluster_ids, weights);
        return on_host(checked(scene_object), camera.camera, shade,
                       [&](const HostScene& host, Span<const Picture<float>> out) {
                           return cpu::draw_metrics(host, camera.camera, rule, given, out[0],
                                                    flag_of(stop));
                       });
    }

    // Bytes of what it keeps on its device by part, and of the pool that those are of.
    py::dict memory() const {
        py::dict parts;
#if V3DG_WITH_CUDA
        if (device_.is_host()) return parts;
        const Work work(device_);
        for (const auto& [name, bytes] : frame_->bytes()) parts[name] = bytes;
        const cuda::PoolBytes pool = cuda::pool_bytes();
        parts["pool, reserved"] = pool.reserved;
        parts["pool, used"] = pool.used;
#endif
        return parts;
    }

    // (instance, cluster, weight, depth), or None.
    py::object pick_cut(const py::object& scene_object, const BoundCamera& camera,
                        const py::array& instance_ids, const py::array& cluster_ids) {
        require_host("pick_cut");
        const std::shared_ptr<const SceneState> state = checked(scene_object).state();
        const GivenCut given = given_cut(instance_ids, cluster_ids, py::none());
        const std::vector<SceneModel> models = models_of(*state);
        ScenePick picked{};
        bool shows_any = false;
        {
            const Unlocked unlocked;
            shows_any = cpu::pick_cut(host_scene(*state, models), camera.camera, given, picked);
        }
        if (!shows_any) return py::none();
        return py::make_tuple(given.instance[picked.pair], given.cluster[picked.pair],
                              picked.weight, picked.depth);
    }

  private:
    BoundPool& checked_pool(const py::object& scene_object, const py::object& pool_object) const {
        const auto& scene = held<BoundScene>(scene_object, "scene");
        auto& pool = held<BoundPool>(pool_object, "pool");
        if (scene.device() != device_ || pool.device() != device_)
            throw py::value_error("scene, pool: expected them on the frame's device");
        pool.check_scene(*scene.state());
        return pool;
    }

    static std::vector<SceneModel> models_in(const BoundPool& pool, const SceneState& scene,
                                             const py::list& colors) {
        std::vector<SceneModel> models;
        for (size_t b = 0; b < scene.tables.size(); ++b) {
            models.push_back({pool.on_host().planes(b),
                              scene.bundle(b).appearance(),
                              {},
                              pool.on_host().codes(b)});
            const auto clusters = static_cast<py::ssize_t>(scene.tables[b].num_clusters());
            if (colors.empty()) continue;
            if (b >= colors.size())
                throw py::value_error("colors: expected none, or of each bundle");
            models.back().cluster_sh =
                span_of<const float>(colors[b].cast<py::array>(), "colors", {clusters, 3}).data;
        }
        return models;
    }

    static std::unique_ptr<BoundDrawing> resident_on_host(const SceneState& scene, BoundPool& pool,
                                                          const Eyes& eyes, const SelectRule& rule,
                                                          float wanted_px2, Shade shade,
                                                          const Stop* stop, const PoolLook& look,
                                                          uint32_t* last_bin) {
        shade.with_depth |= look.counts;
        HostPictures out(eyes, shade);
        if (look.counts)
            for (Picture<float>& picture : out.pictures) std::swap(picture.depth, picture.count);
        const std::vector<SceneModel> models = models_in(pool, scene, look.cluster_colors);
        SceneFrameCounts counts{};
        const auto cut = [&](auto tables, const SelectRule& raised, auto needs) {
            HostScene host{
                tables, {models.data(), models.size()}, scene.instances, needs, last_bin};
            host.colors = look.colors;
            host.wanted_px2 = wanted_px2;
            if (look.chooser) host.chooser = &*look.chooser;
            counts = cpu::draw_scene(host, eyes, raised, out.span(), flag_of(stop));
            return counts.exceeds_budget ? raised.tolerance_px2 : counts.tolerance_px2;
        };
        {
            const Unlocked unlocked;
            pool.frame_on_host(scene, rule, look.is_aside ? PoolFrame::aside : PoolFrame::flight,
                               cut);
        }
        return std::make_unique<BoundDrawing>(std::move(out.out), stats_of(counts));
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

    BoundScene& checked(const py::object& scene_object) const {
        auto& scene = held<BoundScene>(scene_object, "scene");
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

#if V3DG_WITH_CUDA
    void set_models_on_device(const py::list& models, const py::list& palettes) {
        std::vector<cuda::DeviceModel> on_device;
        for (const py::handle& model : models)
            on_device.push_back(model.cast<const BoundModel&>().on_device());
        std::vector<std::shared_ptr<const cuda::DevicePalette>> colors;
        for (const py::handle& palette : palettes)
            colors.push_back(palette.cast<const BoundPalette&>().on_device());
        const Work work(device_);
        frame_->set_models(std::move(on_device), std::move(colors), work.stream());
    }
#endif

    void require_host(const char* name) const {
        if (!device_.is_host())
            throw py::value_error(std::string(name) +
                                  ": expected a frame on the CPU, got one on a CUDA device");
    }

    std::vector<SceneModel> models_of(const SceneState& scene) const {
        std::vector<SceneModel> models(host_.begin(), host_.begin() + scene.tables.size());
        for (size_t b = 0; b < models.size(); ++b)
            models[b].appearance = scene.bundle(b).appearance();
        return models;
    }

    static HostScene host_scene(const SceneState& scene, const std::vector<SceneModel>& models) {
        return {{scene.tables.data(), scene.tables.size()},
                {models.data(), models.size()},
                scene.instances};
    }

    // The windows of the eyes, drawn by draw(host scene, pictures) without Python's lock.
    template <class DrawPictures>
    std::unique_ptr<BoundDrawing> on_host(const BoundScene& scene, const Eyes& eyes,
                                          const Shade& shade, const DrawPictures& draw) const {
        HostPictures out(eyes, shade);
        const std::shared_ptr<const SceneState> state = scene.state();
        const std::vector<SceneModel> models = models_of(*state);
        const py::list gaussians = models_,
                       colors = palettes_;  // which another thread may replace meanwhile
        SceneFrameCounts counts;
        {
            const Unlocked unlocked;
            counts = draw(host_scene(*state, models), out.span());
        }
        return std::make_unique<BoundDrawing>(std::move(out.out), stats_of(counts));
    }

    Device device_;
    py::list models_, palettes_;
    std::vector<size_t> num_gaussians_;  // of each bundle
    std::vector<SceneModel> host_;       // without what the scene knows of the clusters
    std::shared_ptr<std::mutex> turns_;  // on a device
#if V3DG_WITH_CUDA
    std::unique_ptr<cuda::SceneFrame> frame_;  // on a device
#endif
};

// Draws the gaussians of one asset, which have no levels.
class BoundAssetFrame {
  public:
    explicit BoundAssetFrame(const py::object& model) : model_(model) {
        if (held<BoundModel>(model, "model").has_codes())
            throw py::value_error("model: expected one of rows, got one of codes");
        const Work work(held<BoundModel>(model, "model").device());
#if V3DG_WITH_CUDA
        if (work.device().is_host()) return;
        frame_ = std::make_unique<cuda::ModelFrame>();
        turns_ = std::make_shared<std::mutex>();
#endif
    }

    std::unique_ptr<BoundDrawing> draw(const BoundCamera& camera, const Shade& shade,
                                       const Stop* stop) {
        const auto& model = held<BoundModel>(model_, "model");
        if (model.device().is_host()) return on_host(model, camera, shade, stop);
#if V3DG_WITH_CUDA
        const Device device = model.device();
        const Turn turn(turns_.get());
        const Work work(device);
        NewPictures pictures;
        const cuda::EyeImages images = new_images(camera.camera, shade, pictures);
        const cuda::PackedModel& packed = *model.on_device().packed;
        auto drawing = frame_->draw(packed.rows(), view_of_world<float>(camera.camera), 0.0f, false,
                                    images.image[0], work.stream(), &packed.packed(),
                                    images.min_transmittance, place_of(pictures, device));
        return std::make_unique<BoundDrawing>(std::move(pictures), py::cast(this), device, turns_,
                                              std::move(drawing), SelectRule{});
#else
        return nullptr;
#endif
    }

  private:
    static std::unique_ptr<BoundDrawing> on_host(const BoundModel& model, const BoundCamera& camera,
                                                 const Shade& shade, const Stop* stop) {
        HostPictures out(camera.camera, shade);
        SceneFrameCounts counts;
        {
            const Unlocked unlocked;
            counts = cpu::draw_model(*model.on_host().planes, model.size(), camera.camera,
                                     out.pictures[0], flag_of(stop));
        }
        return std::make_unique<BoundDrawing>(std::move(out.out), stats_of(counts));
    }

    py::object model_;
    std::shared_ptr<std::mutex> turns_;  // on a device
#if V3DG_WITH_CUDA
    std::unique_ptr<cuda::ModelFrame> frame_;  // on a device
#endif
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
