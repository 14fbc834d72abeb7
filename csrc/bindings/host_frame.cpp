// Frames and pools on the host. Pictures are in NumPy's memory and are drawn when
// draw() returns, without the GIL. Frames share no buffers, so they need no Turn.

#include "bindings/host_frame.h"

#include <algorithm>
#include <cstring>

#include "base/mutex.h"
#include "residency/host_pages.h"

namespace v3dg::host {

namespace {

// The kinds of frames of a pool. `flight` is a frame of a sequence. `first_look` and
// `look` are steps of settling a view. `aside` draws with the pages that the last frame
// used; it neither brings in pages nor requests any.
enum class PoolFrame { flight, first_look, look, aside };

class HostPool final : public backend::Pool {
  public:
    explicit HostPool(PagePool& pool) : pool_(pool), pages_(pool), needs_(pool.num_bundles()) {}

    // Draws a frame. It brings in pages, calls cut(tables, rule, needs), and passes the
    // page requests to the pool. cut() must return the tolerance that it used. Called
    // without the GIL.
    template <class Cut>
    NotedView frame(const SceneState& scene, SelectRule rule, PoolFrame kind, const Cut& cut) {
        // In a child of fork(), `busy_` could be locked forever.
        pool_.check_process();
        const MutexLock lock(busy_);
        if (kind == PoolFrame::first_look) pool_.begin_settling();
        const bool is_aside = kind == PoolFrame::aside && has_begun_;
        const bool is_bounded = kind == PoolFrame::flight || kind == PoolFrame::aside;
        if (!is_aside) {
            const Arrive arrive = rule.fade.is_on() ? Arrive::fading : Arrive::at_once;
            pages_.apply(pool_, pool_.begin_frame(is_bounded, arrive));
            pool_.release();
            has_begun_ = true;
        }
        std::vector<ClusterTable> tables = scene.tables;
        std::vector<Span<uint32_t>> needs;
        for (size_t b = 0; b < tables.size(); ++b) {
            tables[b].pages.shift = pool_.shift(b);
            tables[b].pages.begins = pool_.begins(b);
            if (is_aside) continue;
            needs_[b].assign(tables[b].num_pages(), 0);
            needs.push_back({needs_[b].data(), needs_[b].size()});
        }
        rule.tolerance_px2 = std::max(rule.tolerance_px2, pool_.least_tolerance_px2());
        rule.frame = pool_.arrivals().frame();
        const float used = cut(Span<const ClusterTable>{tables.data(), tables.size()}, rule,
                               Span<const Span<uint32_t>>{needs.data(), needs.size()});
        return is_aside ? NotedView{} : note_needs(used, is_bounded);
    }

    SettlingStep settle_step(const backend::Scene&, const SceneState& state, const Eyes& eyes,
                             const SelectRule& rule, bool begins, const Work&) override {
        SettlingStep step;
        const PoolFrame kind = begins ? PoolFrame::first_look : PoolFrame::look;
        step.noted =
            frame(state, rule, kind, [&](auto tables, const SelectRule& raised, auto needs) {
                SelectOutput out;
                cpu::select({.bundles = tables,
                             .instances = state.instances,
                             .eyes = eyes,
                             .rule = raised,
                             .needs = needs},
                            out);
                step.tolerance_px2 = out.fits_budget ? out.tolerance_px2 : raised.tolerance_px2;
                return step.tolerance_px2;
            });
        return step;
    }

    // Returns the gaussians of each bundle, with the colours of the request.
    std::vector<SceneModel> models(const SceneState& scene, const FrameRequest& request) const {
        std::vector<SceneModel> models;
        for (size_t b = 0; b < scene.tables.size(); ++b) {
            models.push_back({.planes = pages_.planes(b),
                              .appearance = scene.bundle(b).appearance(),
                              .palette = {},
                              .codes = pages_.codes(b)});
            if (!request.cluster_colors.empty())
                models.back().cluster_sh = request.cluster_colors[b];
        }
        return models;
    }

  private:
    NotedView note_needs(float tolerance_px2, bool is_bounded) V3DG_REQUIRES(busy_) {
        FrameNeeds* needs = pool_.lend_needs();
        size_t count = 0;
        for (uint32_t b = 0; b < needs_.size(); ++b)
            for (uint32_t p = 0; p < needs_[b].size(); ++p) {
                if (needs_[b][p] == 0 || count++ >= pool_.most_needs()) continue;
                PageRequest& need = needs->list[count - 1] = {b, p, 0};
                std::memcpy(&need.priority, &needs_[b][p], sizeof(float));
            }
        needs->count = std::min(count, pool_.most_needs());
        needs->num_left_out = count - needs->count;
        needs->tolerance_px2 = tolerance_px2;
        needs->adapts = is_bounded;
        return pool_.note_needs(needs, !is_bounded);
    }

    PagePool& pool_;
    HostPages pages_;
    Mutex busy_;
    bool has_begun_ V3DG_GUARDED_BY(busy_) = false;  // whether any frame has begun
    // [page] for each bundle
    std::vector<std::vector<uint32_t>> needs_ V3DG_GUARDED_BY(busy_);
};

FrameStats stats_of(const SceneFrameCounts& counts) {
    return {.gaussians = counts.gaussians,
            .in_frustum = counts.render.in_frustum,
            .records = counts.render.records,
            .entries = counts.render.entries,
            .items = 0,
            .tolerance_px2 = counts.tolerance_px2,
            .exceeds_budget = counts.exceeds_budget,
            .select_ms = 1e3 * counts.select_seconds,
            .draw_ms = 1e3 * counts.draw_seconds,
            .levels = counts.levels};
}

BatchStats stats_of(const std::vector<SceneFrameCounts>& counts) {
    BatchStats stats;
    for (const SceneFrameCounts& one : counts) {
        stats.gaussians.push_back(one.gaussians);
        stats.in_frustum.push_back(static_cast<int64_t>(one.render.in_frustum));
        stats.select_ms.push_back(1e3 * one.select_seconds);
        stats.draw_ms.push_back(1e3 * one.draw_seconds);
        stats.levels.push_back(one.levels);
    }
    return stats;
}

// A batch on the host. It is finished when draw_batch() returns.
class DrawnBatch final : public BoundBatch {
  public:
    explicit DrawnBatch(BatchStats stats) : stats_(std::move(stats)) {}
    BatchStats stats() override { return stats_; }

  private:
    const BatchStats stats_;
};

template <class T>
Picture<T> picture_in(NewPicture& made, const Window& window, const Shade& shade) {
    const NewPlanes<T> planes = made.allocate<T>(kHost);
    return {.window = window,
            .background = {T(shade.background[0]), T(shade.background[1]), T(shade.background[2])},
            .color = planes.color,
            .alpha = planes.alpha,
            .depth = planes.depth,
            .count = nullptr,
            .min_transmittance = shade.min_transmittance};
}

// New pictures for the windows of the eyes, and their channels.
struct HostPictures {
    NewPictures made;
    std::vector<Picture<float>> pictures;
    std::vector<Sensor> sensors;

    HostPictures(const Eyes& eyes, const Shade& shade, const SensorRequest& sensor,
                 FrameLook look = FrameLook::appearance) {
        const bool counts = look == FrameLook::count;
        for (int k = 0; k < eyes.count(); ++k) {
            const Window window = window_of(eyes.camera[k]);
            made.emplace_back(window, shade.with_depth || counts);
            pictures.push_back(picture_in<float>(made.back(), window, shade));
            if (counts) std::swap(pictures.back().depth, pictures.back().count);
            const std::vector<py::ssize_t> shape{window.height(), window.width()};
            const size_t num_pixels = static_cast<size_t>(shape[0] * shape[1]);
            sensors.push_back(
                {.planes = made.back().channels.allocate(kHost, sensor.channels, shape),
                 .mesh = sensor.mesh.from(static_cast<size_t>(k) * num_pixels)});
        }
    }
    Span<const Sensor> sensor_span() const { return {sensors.data(), sensors.size()}; }
    Span<const Picture<float>> span() const { return {pictures.data(), pictures.size()}; }
};

// The models of a frame. The object is immutable. A frame in progress keeps it while
// another thread sets new models.
struct HostModels {
    std::vector<std::shared_ptr<const backend::Model>> models;
    std::vector<std::shared_ptr<const backend::Palette>> palettes;

    std::vector<SceneModel> of_scene(const SceneState& scene) const {
        std::vector<SceneModel> drawn;
        drawn.reserve(scene.tables.size());
        for (size_t b = 0; b < scene.tables.size(); ++b) {
            const auto& model = static_cast<const HostModel&>(*models[b]);
            drawn.push_back({.planes = model.planes(),
                             .appearance = scene.bundle(b).appearance(),
                             .palette = {},
                             .codes = model.codes()});
            if (!palettes.empty())
                drawn.back().palette = static_cast<const HostPalette&>(*palettes[b]).palette();
        }
        return drawn;
    }
};

class HostFrame final : public backend::Frame {
  public:
    void set_models(std::vector<std::shared_ptr<const backend::Model>> models,
                    std::vector<std::shared_ptr<const backend::Palette>> palettes,
                    const Work&) override {
        models_ = std::make_shared<HostModels>(HostModels{std::move(models), std::move(palettes)});
    }

    std::unique_ptr<BoundDrawing> draw(const backend::FrameInput& input) override {
        const FrameRequest& request = input.request;
        if (request.cut) return draw_paced(input, request.rule, nullptr);
        return in_steps(input.steps, request.rule, request.choosing_eyes(), input.state,
                        [&](const SelectRule& paced, uint32_t* last_bin) {
                            return draw_paced(input, paced, last_bin);
                        });
    }

    std::unique_ptr<BoundBatch> draw_batch(const backend::BatchInput& input) override {
        const BoundCameras& cameras = input.cameras;
        const SceneState& state = *input.state;
        const std::shared_ptr<const HostModels> kept = models_;
        const std::vector<SceneModel> models = kept->of_scene(state);
        std::vector<SceneFrameCounts> counts(cameras.size());
        {
            const Unlocked unlocked;
            const std::vector<Camera> camera = cameras.on_host();
            std::vector<int32_t> environment(cameras.size(), kSeesAll);
            const auto* given = static_cast<const int32_t*>(cameras.environments().data);
            if (given != nullptr) environment.assign(given, given + cameras.size());
            cpu::draw_batch(HostScene{.tables = {state.tables.data(), state.tables.size()},
                                      .models = {models.data(), models.size()},
                                      .instances = state.instances,
                                      .labels = state.label_span()},
                            input.request,
                            {.camera = {camera.data(), camera.size()},
                             .environment = {environment.data(), environment.size()},
                             .environments = state.environments->table()},
                            {counts.data(), counts.size()});
        }
        return std::make_unique<DrawnBatch>(stats_of(counts));
    }

    bool pick(const backend::FrameInput& input, ScenePick& picked) override {
        const FrameRequest& request = input.request;
        bool shows_any = false;
        with_scene(input, request.rule, PoolFrame::aside, nullptr,
                   [&](const HostScene& scene, const SelectRule& rule) {
                       shows_any = cpu::pick_scene(scene, request, rule, picked);
                       return rule.tolerance_px2;
                   });
        return shows_any;
    }

    std::vector<std::pair<const char*, size_t>> memory() const override { return {}; }

  private:
    std::unique_ptr<BoundDrawing> draw_paced(const backend::FrameInput& input,
                                             const SelectRule& paced, uint32_t* last_bin) const {
        const FrameRequest& request = input.request;
        HostPictures out(request.eyes, request.shade, request.sensor, request.look);
        SceneFrameCounts counts{};
        const PoolFrame kind = request.is_aside ? PoolFrame::aside : PoolFrame::flight;
        with_scene(input, paced, kind, last_bin,
                   [&](const HostScene& scene, const SelectRule& rule) {
                       counts = cpu::draw_scene(scene, request, rule, out.span(), out.sensor_span(),
                                                input.stop);
                       return counts.exceeds_budget ? rule.tolerance_px2 : counts.tolerance_px2;
                   });
        return std::make_unique<BoundDrawing>(std::move(out.made), stats_of(counts));
    }

    // Calls body(scene, rule) without the GIL. The scene has the models that were set
    // or, with a pool, the resident part of the pool. body() must return the tolerance
    // that it used.
    template <class Body>
    void with_scene(const backend::FrameInput& input, const SelectRule& rule, PoolFrame kind,
                    uint32_t* last_bin, const Body& body) const {
        const SceneState& state = *input.state;
        if (input.pool != nullptr) {
            auto& pool = static_cast<HostPool&>(*input.pool);
            const std::vector<SceneModel> models = pool.models(state, input.request);
            const Unlocked unlocked;
            pool.frame(state, rule, kind, [&](auto tables, const SelectRule& raised, auto needs) {
                return body(HostScene{.tables = tables,
                                      .models = {models.data(), models.size()},
                                      .instances = state.instances,
                                      .needs = needs,
                                      .last_bin = last_bin,
                                      .labels = state.label_span()},
                            raised);
            });
            return;
        }
        const std::shared_ptr<const HostModels> kept = models_;
        const std::vector<SceneModel> models = kept->of_scene(state);
        const Unlocked unlocked;
        body(HostScene{.tables = {state.tables.data(), state.tables.size()},
                       .models = {models.data(), models.size()},
                       .instances = state.instances,
                       .last_bin = last_bin,
                       .labels = state.label_span()},
             rule);
    }

    std::shared_ptr<const HostModels> models_ = std::make_shared<HostModels>();
};

class HostAssetFrame final : public backend::AssetFrame {
  public:
    HostAssetFrame(std::shared_ptr<const backend::Model> model, Appearance<float> appearance)
        : model_(std::move(model)), appearance_(appearance) {}

    std::unique_ptr<BoundDrawing> draw(const Camera& camera, const Shade& shade,
                                       const SensorRequest& sensor,
                                       const std::atomic<bool>* stop) override {
        const auto& model = static_cast<const HostModel&>(*model_);
        HostPictures out(camera, shade, sensor);
        SceneFrameCounts counts;
        {
            const Unlocked unlocked;
            counts = cpu::draw_model(*model.planes(), model.size(), appearance_, camera,
                                     out.pictures[0], out.sensors[0], stop);
        }
        return std::make_unique<BoundDrawing>(std::move(out.made), stats_of(counts));
    }

  private:
    const std::shared_ptr<const backend::Model> model_;
    const Appearance<float> appearance_;
};

template <class T>
class HostTape final : public Tape {
  public:
    HostTape(const GaussianRows<const T>& rows, const BoundCamera& camera, const DrawLook& look)
        : model_(rows),
          draw_{.model = &model_.planes(),
                .first = 0,
                .count = model_.size(),
                .view = view_of_world<T>(camera.camera),
                .appearance = {T(look.filter_px2), look.antialiased, false}},
          camera_(camera.camera.intrinsics<T>()),
          height_(camera.height()),
          width_(camera.width()),
          background_(look.background) {}

    RenderCounts draw(const Picture<T>& picture, bool keeps_tape) {
        return render<T>({draw_}, camera_, picture, keeps_tape, workspace_);
    }

    Gradients backward(const py::object& d_color, const py::object& d_alpha,
                       const py::object& d_depth, Centers wanted) override {
        const py::ssize_t h = height_;
        const py::ssize_t w = width_;
        const GradientPlane<T> color(d_color, "d_color", kHost, {h, w, 3});
        const GradientPlane<T> alpha(d_alpha, "d_alpha", kHost, {h, w});
        const PictureGradient<T> d_picture{
            color.span.data, alpha.span.data,
            elements_or_null<const T>(kHost, d_depth, "d_depth", {h, w})};
        const auto n = static_cast<py::ssize_t>(model_.size());
        const int degree = model_.planes().sh_degree;
        Gradients made;
        const GaussianRows<T> out{.means = zeros<T>({n, 3}, made.means),
                                  .quats = zeros<T>({n, 4}, made.quats),
                                  .scales = zeros<T>({n, 3}, made.scales),
                                  .opacities = zeros<T>({n}, made.opacities),
                                  .sh = zeros<T>({n, num_sh_bases(degree), 3}, made.sh),
                                  .size = model_.size(),
                                  .sh_degree = degree};
        T* const background = zeros<T>({3}, made.background);
        CenterGradients<T> centers{};
        if (wanted.sum) centers.sum = zeros<T>({n, 2}, made.centers);
        if (wanted.size)
            centers.size = reinterpret_cast<CenterSize<T>*>(zeros<T>({n, 2}, made.center_sizes));
        {
            const Unlocked unlocked;
            const Picture<T> picture{
                .window = {0, 0, width_, height_},
                .background = {T(background_[0]), T(background_[1]), T(background_[2])},
                .color = nullptr,
                .alpha = nullptr,
                .depth = nullptr};
            render_backward<T>(draw_, camera_, picture, d_picture, workspace_, out, centers,
                               background);
        }
        return made;
    }

  private:
    ::v3dg::Model<T> model_;
    Draw<T> draw_;
    Intrinsics<T> camera_;
    int height_, width_;
    std::array<double, 3> background_;
    Workspace<T> workspace_;
};

template <class T>
Rasterized rasterize_as(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                        bool with_depth, bool keep_tape) {
    const Window window{0, 0, camera.width(), camera.height()};
    NewPicture made(window, with_depth);
    const Picture<T> picture = picture_in<T>(made, window, Shade{.background = look.background});
    const GaussianRows<const T> rows = look.read<T>(gaussians);
    std::unique_ptr<HostTape<T>> tape;
    RenderCounts counts;
    {
        const Unlocked unlocked;
        tape = std::make_unique<HostTape<T>>(rows, camera, look);
        counts = tape->draw(picture, keep_tape);
    }
    return {.color = made.color,
            .alpha = made.alpha,
            .depth = made.depth,
            .counts = counts,
            .tape = keep_tape ? std::move(tape) : nullptr};
}

}  // namespace

HostModel::HostModel(const GaussianRows<const float>& rows) : size_(rows.size) {
    const Unlocked unlocked;
    planes_ = std::make_unique<::v3dg::Model<float>>(rows);
}

HostModel::HostModel(const py::object& codes) : codes_object_(codes) {
    const auto& given = held<BoundCodes>(codes, "codes");
    size_ = given.num_gaussians();
    codes_ = given.pages().codes();
}

size_t HostModel::bytes() const {
    if (planes_ != nullptr) return planes_->bytes();
    return codes_.range_size * codes_.num_clusters();
}

void HostModel::decode(Span<const int32_t> clusters, Span<const int64_t> offset, const Work&,
                       const GaussianRows<float>& out) const {
    cpu::decode({codes_, clusters, offset}, out);
}

HostPalette::HostPalette(const py::object& table, const py::array& sh) : table_(table), sh_(sh) {
    const ClusterTable& clusters = held<BoundTable>(table, "table").table();
    const auto count = static_cast<py::ssize_t>(clusters.num_clusters());
    palette_ = {span_of<const float>(sh, "sh", {count, 3}).data, clusters.offset.data,
                static_cast<uint32_t>(count)};
}

std::unique_ptr<backend::Pool> make_pool(PagePool& pool) {
    return std::make_unique<HostPool>(pool);
}

std::unique_ptr<backend::Frame> make_frame() { return std::make_unique<HostFrame>(); }

std::unique_ptr<backend::AssetFrame> make_asset_frame(std::shared_ptr<const backend::Model> model,
                                                      Appearance<float> appearance) {
    return std::make_unique<HostAssetFrame>(std::move(model), appearance);
}

Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                     bool with_depth, bool keep_tape) {
    return gaussians.is_double()
               ? rasterize_as<double>(gaussians, camera, look, with_depth, keep_tape)
               : rasterize_as<float>(gaussians, camera, look, with_depth, keep_tape);
}

}  // namespace v3dg::host
