#pragma once

// Frames of a scene on the host: a request in, pictures and what they came to out.

#include <atomic>
#include <vector>

#include "draw/render.h"
#include "draw/request.h"

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

// A scene on the host: what selection reads of its bundles, their gaussians, and its instances.
struct HostScene {
    Span<const ClusterTable> tables;
    Span<const SceneModel> models;  // of the same bundles
    InstanceTable instances;
    // As SelectInput has them.
    Span<const Span<uint32_t>> needs = {};
    uint32_t* last_bin = nullptr;
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

// The gaussian that a pixel shows most of, and the pair that it belongs to.
struct ScenePick {
    int32_t instance, cluster;
    float weight;  // its share of the pixel
    float depth;
};

namespace cpu {

// Metrics are shown up to so many times the tolerance.
constexpr float kMostShare = 2.0f;

// Draws what is asked for, a picture for each eye. `rule` is the one of the request, as a pool or
// the pacing of a budget has changed it. A given cut has a picture for the first eye alone; throws
// std::out_of_range where one of its pairs is not of the scene. Once `stop` is true, returns soon
// and leaves the pictures unfinished.
SceneFrameCounts draw_scene(const HostScene& scene, const FrameRequest& request,
                            const SelectRule& rule, Span<const Picture<float>> pictures,
                            const std::atomic<bool>* stop = nullptr);

// Draws all gaussians of one model, in the world.
SceneFrameCounts draw_model(const GaussianPlanes<float>& model, size_t count,
                            const Appearance<float>& appearance, const Camera& camera,
                            const Picture<float>& picture, const std::atomic<bool>* stop = nullptr);

// Finds the gaussian that the first pixel of the first eye's window shows most of, of the cut that
// draw_scene() would draw. Returns whether there is any.
bool pick_scene(const HostScene& scene, const FrameRequest& request, const SelectRule& rule,
                ScenePick& picked);

}  // namespace cpu
}  // namespace v3dg
