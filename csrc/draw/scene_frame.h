#pragma once

// Frames of a scene on the host: the input is a request, the output are pictures and
// counts.

#include <atomic>
#include <vector>

#include "draw/render.h"
#include "draw/request.h"
#include "residency/environments.h"

namespace v3dg {

// The gaussians of one bundle on the host, and the appearance of its clusters.
struct SceneModel {
    const GaussianPlanes<float>* planes;  // null if the gaussians are codes
    ClusterAppearance appearance;
    Palette palette;
    const Codes* codes = nullptr;
    // [C][3] SH coefficients of degree 0, which replace the palette of clusters; null:
    // none.
    const float* cluster_sh = nullptr;
};

// A scene on the host: the bundle tables that selection reads, the gaussians, and the
// instances.
struct HostScene {
    Span<const ClusterTable> tables;
    Span<const SceneModel> models;  // of the same bundles
    InstanceTable instances;
    // See SelectInput.
    Span<const Span<uint32_t>> needs = {};
    uint32_t* last_bin = nullptr;
    Span<const ClusterRuns> runs = {};
};

// The cameras of a batch on the host. All have the size of the request, and belong to
// environments of the scene.
struct HostCameras {
    Span<const Camera> camera;          // [B]
    Span<const int32_t> environment;    // [B] as in EnvironmentTable
    EnvironmentTable environments;      // of the scene's instances
};

// The counts of one frame.
struct SceneFrameCounts {
    int64_t gaussians;  // selected gaussians; if the budget is exceeded, those of the coarsest cut
    float tolerance_px2;  // the tolerance that was used
    bool exceeds_budget;  // if so, nothing was drawn
    double select_seconds, draw_seconds;
    RenderCounts render;          // sums over both pictures, if there are two
    std::vector<int64_t> levels;  // selected gaussians by level; for scenes only

    // Adds the counts of another picture of the same frame.
    void add_picture(const SceneFrameCounts& other) {
        draw_seconds += other.draw_seconds;
        render.in_frustum += other.render.in_frustum;
        render.records += other.render.records;
        render.entries += other.render.entries;
    }
};

// The gaussian with the largest weight in a pixel, and its pair.
struct ScenePick {
    int32_t instance, cluster;
    float weight;  // its blend weight
    float depth;
};

namespace cpu {

// Metrics are shown up to this multiple of the tolerance.
constexpr float kMostShare = 2.0f;

// Draws a request, one picture per eye. `rule` is the rule of the request after changes
// by a pool or by the pacing of a budget. A given cut is drawn for the first eye only;
// throws std::out_of_range if one of its pairs is not in the scene. Once `stop` is
// true, it returns soon and leaves the pictures unfinished.
SceneFrameCounts draw_scene(const HostScene& scene, const FrameRequest& request,
                            const SelectRule& rule, Span<const Picture<float>> pictures,
                            const std::atomic<bool>* stop = nullptr);

// Draws a picture for each camera, with the decisions and the pixels that draw_scene()
// gives for the instances that the camera sees. Threads process a camera each; the
// cameras that do not occupy all threads are drawn one after another by all of them.
void draw_batch(const HostScene& scene, const BatchRequest& request, const HostCameras& cameras,
                Span<SceneFrameCounts> counts);

// Draws all gaussians of one model, in world coordinates.
SceneFrameCounts draw_model(const GaussianPlanes<float>& model, size_t count,
                            const Appearance<float>& appearance, const Camera& camera,
                            const Picture<float>& picture, const std::atomic<bool>* stop = nullptr);

// Finds the gaussian with the largest weight in the first pixel of the first eye's
// window, for the cut that draw_scene() would draw. Returns whether there is any.
bool pick_scene(const HostScene& scene, const FrameRequest& request, const SelectRule& rule,
                ScenePick& picked);

}  // namespace cpu
}  // namespace v3dg
