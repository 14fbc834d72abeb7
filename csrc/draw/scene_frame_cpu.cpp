// Implements scene_frame.h: converts the clusters of a cut to draws, and sets their
// false colours.

#include "draw/scene_frame.h"

#include <algorithm>
#include <memory>
#include <stdexcept>
#include <string>

#include "base/clock.h"
#include "base/parallel_for.h"
#include "draw/cut_draws.h"
#include "draw/false_color.h"
#include "draw/seen_instances.h"
#include "draw/sense.h"
#include "math/sh.h"

namespace v3dg {

namespace {

// A workspace that is reused from frame to frame. Only one caller at a time can take
// it; concurrent callers get new workspaces. The pointer is atomic instead of guarded
// by a mutex, because a mutex could stay locked in the child of a fork().
class SharedWorkspace {
  public:
    // The exchange is atomic, because threads may still be drawing when the process
    // exits.
    ~SharedWorkspace() { delete kept_.exchange(nullptr); }
    std::unique_ptr<Workspace<float>> take() {
        std::unique_ptr<Workspace<float>> kept(kept_.exchange(nullptr));
        return kept ? std::move(kept) : std::make_unique<Workspace<float>>();
    }
    // Keeps the workspace for the next frame, unless it is exceptionally large.
    void give_back(std::unique_ptr<Workspace<float>> workspace) {
        constexpr uint64_t kMostRoom = uint64_t(16) << 20;
        if (workspace->most_room <= kMostRoom) workspace.reset(kept_.exchange(workspace.release()));
    }

  private:
    std::atomic<Workspace<float>*> kept_{nullptr};
};

SharedWorkspace& shared_workspace() {
    static SharedWorkspace shared;
    return shared;
}

// The shared workspace, borrowed until this object is destroyed.
class LentWorkspace {
  public:
    LentWorkspace() : workspace_(shared_workspace().take()) {}
    ~LentWorkspace() { shared_workspace().give_back(std::move(workspace_)); }
    LentWorkspace(const LentWorkspace&) = delete;
    LentWorkspace& operator=(const LentWorkspace&) = delete;

    Workspace<float>& operator*() const { return *workspace_; }

  private:
    std::unique_ptr<Workspace<float>> workspace_;
};

// Returns the ratio of metric to tolerance of each pair: (S).
std::vector<float> shares_of(const HostScene& scene, const Camera& camera, const SelectRule& rule,
                             const GivenCut& given, float tolerance_px2) {
    std::vector<float> share(given.instance.size);
    cpu::pair_metrics({scene.tables, scene.instances, camera, rule}, given,
                      {share.data(), share.size()});
    for (float& value : share) value = value > 0.0f ? value / tolerance_px2 : 0.0f;
    return share;
}

void set_tint(const Rgb& rgb, float* tint) {
    for (int a = 0; a < 3; ++a) tint[a] = (rgb[a] - 0.5f) / static_cast<float>(kShBase0);
}

// `tolerance_px2` is the tolerance of the cut.
SceneFrameCounts draw_pairs(const HostScene& scene, const Camera& camera, const GivenCut& given,
                            float tolerance_px2, const float* tint, Picture<float> picture,
                            const Sensor& sensor, Workspace<float>& workspace,
                            const std::atomic<bool>* stop) {
    const double start = now();
    picture.min_transmittance = stop_of_cut(picture.min_transmittance, tolerance_px2);
    const CutDraws cut(scene, camera, given, tint);
    const DrawnSensor drawn{
        .sensor = sensor, .instance_of_draw = cut.instances(), .label_of_instance = scene.labels};
    SceneFrameCounts counts{};
    counts.render = render<float>(cut.draws(), camera.intrinsics<float>(), picture, false,
                                  workspace, stop, sensor.is_on() ? &drawn : nullptr);
    counts.gaussians = cut.num_gaussians();
    counts.draw_seconds = now() - start;
    return counts;
}

int level_of(const ClusterTable& table, int32_t cluster) {
    const int32_t own = table.own_group[cluster];
    return own < 0 ? 0 : table.level[own];
}

std::vector<int64_t> levels_of(const HostScene& scene, const GivenCut& given) {
    std::vector<int64_t> levels;
    for (size_t s = 0; s < given.instance.size; ++s) {
        const ClusterTable& table = scene.tables[scene.instances.bundle[given.instance[s]]];
        const auto level = static_cast<size_t>(level_of(table, given.cluster[s]));
        if (level >= levels.size()) levels.resize(level + 1);
        levels[level] += static_cast<int64_t>(table.num_gaussians(given.cluster[s]));
    }
    return levels;
}

// Returns the false colours of the pairs, [S][3], which replace the colours of the
// gaussians. If the request has no false colours, the result is empty. `tolerance_px2`
// is the tolerance of the cut.
std::vector<float> tint_of(const HostScene& scene, const FrameRequest& request,
                           const SelectRule& rule, const GivenCut& given, float tolerance_px2) {
    const bool is_metric = request.look == FrameLook::metrics;
    if (!is_metric && request.look != FrameLook::missing) return {};
    // Metrics are shown for the eye that views the picture. Missing pages are shown for
    // the eye for which the cut was selected.
    const Camera& judge = is_metric ? request.eyes.camera[0] : request.choosing_eyes().camera[0];
    // The tolerance to compare metrics with. To show missing pages without a budget,
    // use the requested tolerance, because the pool may have raised the tolerance of
    // the cut. In all other cases, use the tolerance of the cut.
    const bool wants_used = is_metric || rule.budget != kNoBudget;
    const float wanted = wants_used ? tolerance_px2 : request.rule.tolerance_px2;
    std::vector<float> tint(3 * given.instance.size);
    const std::vector<float> share =
        shares_of(scene, judge, rule, given, is_metric ? wanted : std::max(wanted, 1e-6f));
    for (size_t s = 0; s < share.size(); ++s) {
        const ClusterTable& table = scene.tables[scene.instances.bundle[given.instance[s]]];
        const bool is_finest = level_of(table, given.cluster[s]) <= rule.min_level;
        const float grey = std::min(share[s], cpu::kMostShare);
        // The factor 1.0001 is a margin for rounding of metrics.
        const Rgb rgb =
            is_metric ? Rgb{grey, grey, grey}
                      : missing_color(is_finest ? 0.0f : share[s], 1.0001f * rule.fade.factor);
        set_tint(rgb, tint.data() + 3 * s);
    }
    return tint;
}

void select_for(const HostScene& scene, const FrameRequest& request, const SelectRule& rule,
                SelectOutput& out) {
    cpu::select({.bundles = scene.tables,
                 .instances = scene.instances,
                 .eyes = request.choosing_eyes(),
                 .rule = rule,
                 .needs = scene.needs,
                 .last_bin = scene.last_bin,
                 .runs = scene.runs},
                out);
}

// Sets the channel `clipped` of a picture from the given pairs.
void clip_pairs(const HostScene& scene, const Camera& camera, const GivenCut& given,
                const Window& window, uint8_t* clipped, const std::atomic<bool>* stop) {
    const PixelSlopes slopes(camera.pinhole());
    mark_clipped(CutDraws(scene, camera, given).draws(), slopes, window, clipped, stop);
}

// Sets the channel `clipped` of a picture whose cut has this tolerance. The cut that
// was drawn omits clusters in front of the near plane or beside the frustum. Therefore
// the cut is selected again, without culling.
void clip_selected(const HostScene& scene, const Camera& camera, SelectRule rule,
                   float tolerance_px2, const Window& window, uint8_t* clipped,
                   const std::atomic<bool>* stop) {
    HostScene whole = scene;
    whole.needs = {};
    whole.last_bin = nullptr;
    rule.tolerance_px2 = tolerance_px2;
    rule.budget = kNoBudget;
    rule.culls = false;
    SelectOutput cut;
    select_for(whole, {.eyes = camera, .rule = rule, .shade = {}}, rule, cut);
    clip_pairs(whole, camera, pairs_of(cut), window, clipped, stop);
}

SceneFrameCounts draw_given(const HostScene& scene, const FrameRequest& request,
                            const SelectRule& rule, const Picture<float>& picture,
                            const Sensor& sensor, const std::atomic<bool>* stop) {
    const Camera& camera = request.eyes.camera[0];
    const GivenCut& given = *request.cut;
    std::vector<float> tint;
    if (request.look == FrameLook::metrics) {
        // CutDraws throws an error if a pair is not in the scene.
        static_cast<void>(CutDraws(scene, camera, given));
        tint = tint_of(scene, request, rule, given, rule.tolerance_px2);
    }
    if (sensor.planes.clipped != nullptr)
        clip_pairs(scene, camera, given, picture.window, sensor.planes.clipped, stop);
    const LentWorkspace workspace;
    return draw_pairs(scene, camera, given, rule.tolerance_px2,
                      tint.empty() ? nullptr : tint.data(), picture, sensor, *workspace, stop);
}

SceneFrameCounts draw_selected(const HostScene& scene, const FrameRequest& request,
                               const SelectRule& rule, Span<const Picture<float>> pictures,
                               Span<const Sensor> sensors, Workspace<float>& workspace,
                               const std::atomic<bool>* stop) {
    const double start = now();
    SelectOutput cut;
    select_for(scene, request, rule, cut);
    const double select_seconds = now() - start;
    const GivenCut given = pairs_of(cut);
    std::vector<float> tint;
    if (cut.fits_budget) tint = tint_of(scene, request, rule, given, cut.tolerance_px2);
    SceneFrameCounts counts{};
    for (size_t k = 0; k < pictures.size && cut.fits_budget; ++k) {
        const Sensor sensor = sensors.empty() ? Sensor{} : sensors[k];
        const Camera& camera = request.eyes.camera[k];
        counts.add_picture(draw_pairs(scene, camera, given, cut.tolerance_px2,
                                      tint.empty() ? nullptr : tint.data(), pictures[k], sensor,
                                      workspace, stop));
        if (sensor.planes.clipped != nullptr)
            clip_selected(scene, camera, rule, cut.tolerance_px2, pictures[k].window,
                          sensor.planes.clipped, stop);
    }
    counts.gaussians = cut.num_gaussians;
    counts.tolerance_px2 = cut.tolerance_px2;
    counts.exceeds_budget = !cut.fits_budget;
    counts.select_seconds = select_seconds;
    counts.levels = levels_of(scene, given);
    return counts;
}

// Returns the picture of camera k, whose planes are part of those of a batch.
Picture<float> picture_of(const BatchRequest& request, size_t k) {
    const size_t num_pixels = static_cast<size_t>(request.width) * request.height;
    const BatchPlanes planes = request.planes.from(k * num_pixels);
    const std::array<double, 3>& color = request.shade.background;
    return {.window = {0, 0, request.width, request.height},
            .background = {float(color[0]), float(color[1]), float(color[2])},
            .color = planes.color,
            .alpha = planes.alpha_plane(),
            .depth = planes.depth,
            .count = nullptr,
            .min_transmittance =
                stop_of_cut(request.shade.min_transmittance, request.rule.tolerance_px2),
            .color_step = planes.channels,
            .alpha_step = planes.alpha_step()};
}

// Draws the picture of camera k.
SceneFrameCounts draw_picture(const HostScene& scene, const BatchRequest& request,
                              const HostCameras& cameras, size_t k, Workspace<float>& workspace) {
    const FrameRequest one{.eyes = cameras.camera[k], .rule = request.rule, .shade = request.shade};
    const Picture<float> picture = picture_of(request, k);
    const size_t num_pixels = static_cast<size_t>(request.width) * request.height;
    const Sensor sensor = request.sensor.from(k * num_pixels);
    const int32_t environment = cameras.environment[k];
    if (environment == kSeesAll)
        return draw_selected(scene, one, request.rule, {&picture, 1}, {&sensor, 1}, workspace,
                             nullptr);
    const SeenInstances seen(scene.instances, cameras.environments, environment);
    return draw_selected(seen.part_of(scene), one, request.rule, {&picture, 1}, {&sensor, 1},
                         workspace, nullptr);
}

}  // namespace

SceneFrameCounts cpu::draw_scene(const HostScene& scene, const FrameRequest& request,
                                 const SelectRule& rule, Span<const Picture<float>> pictures,
                                 Span<const Sensor> sensors, const std::atomic<bool>* stop) {
    if (request.cut) {
        const Sensor sensor = sensors.empty() ? Sensor{} : sensors[0];
        return draw_given(scene, request, rule, pictures[0], sensor, stop);
    }
    const LentWorkspace workspace;
    return draw_selected(scene, request, rule, pictures, sensors, *workspace, stop);
}

void cpu::draw_batch(const HostScene& scene, const BatchRequest& request,
                     const HostCameras& cameras, Span<SceneFrameCounts> counts) {
    const size_t count = cameras.camera.size, num_threads = static_cast<size_t>(most_threads());
    HostScene shared = scene;
    const size_t num_spread = count / num_threads * num_threads;
    const std::vector<ClusterRuns> runs = runs_of_bundles(scene.tables, scene.instances, count);
    shared.runs = {runs.data(), runs.size()};
    std::vector<Workspace<float>> workspaces(std::min(count, num_threads));
    const auto draw = [&](size_t k) {
        // Inside a nested parallel loop, there is one thread with the index 0, so each
        // thread uses its own workspace.
        Workspace<float>& workspace = workspaces[thread_index()];
        counts[k] = draw_picture(shared, request, cameras, k, workspace);
    };
    parallel_for(num_spread, 1, draw);
    for (size_t k = num_spread; k < count; ++k) draw(k);
}

SceneFrameCounts cpu::draw_model(const GaussianPlanes<float>& model, size_t count,
                                 const Appearance<float>& appearance, const Camera& camera,
                                 const Picture<float>& picture, const Sensor& sensor,
                                 const std::atomic<bool>* stop) {
    const double start = now();
    const std::vector<Draw<float>> draws{
        {&model, 0, count, view_of_world<float>(camera), appearance}};
    const int32_t only = 0;
    const DrawnSensor drawn{
        .sensor = sensor, .instance_of_draw = {&only, 1}, .label_of_instance = {}};
    const LentWorkspace workspace;
    SceneFrameCounts counts{};
    counts.render = render<float>(draws, camera.intrinsics<float>(), picture, false, *workspace,
                                  stop, sensor.is_on() ? &drawn : nullptr);
    if (sensor.planes.clipped != nullptr)
        mark_clipped(draws, PixelSlopes(camera.pinhole()), picture.window, sensor.planes.clipped,
                     stop);
    counts.gaussians = static_cast<int64_t>(count);
    counts.draw_seconds = now() - start;
    return counts;
}

bool cpu::pick_scene(const HostScene& scene, const FrameRequest& request, const SelectRule& rule,
                     ScenePick& picked) {
    SelectOutput selected;
    if (!request.cut) select_for(scene, request, rule, selected);
    const GivenCut given = request.cut ? *request.cut : pairs_of(selected);
    const Camera& camera = request.eyes.camera[0];
    const CutDraws cut(scene, camera, given);
    Pick found{};
    if (!pick(cut.draws(), camera.intrinsics<float>(), static_cast<int>(camera.x0),
              static_cast<int>(camera.y0), found))
        return false;
    const size_t pair = cut.pair_of(found.gaussian);
    picked = {.instance = given.instance[pair],
              .cluster = given.cluster[pair],
              .weight = found.weight,
              .depth = found.depth};
    return true;
}

}  // namespace v3dg
