#pragma once

#include <atomic>
#include <vector>

#include "draw/render.h"
#include "select/select.h"

namespace v3dg {

// The gaussians of one bundle on the host, and how its clusters are drawn.
struct SceneModel {
    const GaussianPlanes<float>* planes;  // null where there are codes
    ClusterAppearance appearance;
    Palette palette;
    const Codes* codes = nullptr;
    // [C][3] coefficients of the constant basis, in place of the palette where clusters lie here
    // and there.
    const float* cluster_sh = nullptr;
};

// What colours of a cut's clusters say: nothing, where finer pages are missing (see
// missing_color()), or the share of the cut's tolerance that metrics take, as draw_metrics() has
// it.
enum class SceneColors { own, missing, metrics };

// A scene on the host: what selection reads of its bundles, their gaussians, and its instances.
struct HostScene {
    Span<const ClusterTable> tables;
    Span<const SceneModel> models;  // of the same bundles
    InstanceTable instances;
    // As SelectInput has them.
    Span<const Span<uint32_t>> needs = {};
    uint32_t* last_bin = nullptr;
    SceneColors colors = SceneColors::own;
    float wanted_px2 = 0.0f;        // what is missing, where it is not of this tolerance
    const Eyes* chooser = nullptr;  // which the cut is for; null: those that look
};

// What one frame came to.
struct SceneFrameCounts {
    int64_t
        gaussians;  // that were selected; where the budget is exceeded, what the coarsest cut has
    float tolerance_px2;  // that was used
    bool exceeds_budget;  // nothing was drawn then
    double select_seconds, draw_seconds;
    RenderCounts render;          // of two pictures, the sums
    std::vector<int64_t> levels;  // gaussians that were selected, of a scene by level

    // What another picture of the same frame came to.
    void add_picture(const SceneFrameCounts& other) {
        draw_seconds += other.draw_seconds;
        render.in_frustum += other.render.in_frustum;
        render.records += other.render.records;
        render.entries += other.render.entries;
    }
};

// Where a pixel's gaussian comes from.
struct ScenePick {
    size_t pair;  // place in the cut
    float weight, depth;
};

namespace cpu {

// Selects what the windows of the eyes need, which share a cut, and draws a picture for each. Once
// `stop` is true, returns soon and leaves the pictures unfinished.
SceneFrameCounts draw_scene(const HostScene& scene, const Eyes& eyes, const SelectRule& rule,
                            Span<const Picture<float>> pictures,
                            const std::atomic<bool>* stop = nullptr);

// Draws pairs that were selected before. Throws std::out_of_range where one is not of the scene.
SceneFrameCounts draw_cut(const HostScene& scene, const Camera& camera, const GivenCut& given,
                          const Picture<float>& picture, const std::atomic<bool>* stop = nullptr);

// The same in shades of grey: the metric of each pair (see pair_metrics) over the rule's tolerance,
// at most kMostShare.
constexpr float kMostShare = 2.0f;
SceneFrameCounts draw_metrics(const HostScene& scene, const Camera& camera, const SelectRule& rule,
                              const GivenCut& given, const Picture<float>& picture,
                              const std::atomic<bool>* stop = nullptr);

// Draws all gaussians of one model, in the world, without a filter.
SceneFrameCounts draw_model(const GaussianPlanes<float>& model, size_t count, const Camera& camera,
                            const Picture<float>& picture, const std::atomic<bool>* stop = nullptr);

// The gaussian that the first pixel of the camera's window shows most of. Returns whether there is
// any.
bool pick_cut(const HostScene& scene, const Camera& camera, const GivenCut& given,
              ScenePick& picked);

}  // namespace cpu
}  // namespace v3dg
