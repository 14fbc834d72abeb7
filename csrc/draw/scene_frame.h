#pragma once

// Draws frames of a scene on the host: turns a request into pictures and counts.

#include <atomic>
#include <vector>

#include "draw/render.h"
#include "draw/request.h"
#include "residency/environments.h"

namespace v3dg {

// The gaussians of one bundle on the host, and the appearance of its clusters.
struct SceneModel {
    const GaussianPlanes<float>* planes;  // null if the gaussians are coded
    ClusterAppearance appearance;
    Palette palette;
    const Codes* codes = nullptr;
    // [C][3] SH coefficients of degree 0: colours of clusters that replace the palette.
    // May be null.
    const float* cluster_sh = nullptr;
};

// A scene on the host: the tables for selection, the gaussians, and the instances.
struct HostScene {
    Span<const ClusterTable> tables;
    Span<const SceneModel> models;  // one per table
    InstanceTable instances;
    // Optional outputs of selection, as in SelectInput.
    Span<const Span<uint32_t>> needs = {};
    uint32_t* last_bin = nullptr;
    Span<const ClusterRuns> runs = {};
    // For sensors that output ids. `labels` has the label of each instance of the whole
    // scene, and is empty if no instance has one. If `instances` is only a part of the
    // scene, `ids` has the ids of that part in the whole scene.
    Span<const int32_t> labels = {};
    Span<const int32_t> instance_ids = {};
};

// The cameras of a batch on the host. They have the size of the request, and belong to
// environments of the scene.
struct HostCameras {
    Span<const Camera> camera;        // [B]
    Span<const int32_t> environment;  // [B] as described at EnvironmentTable
    EnvironmentTable environments;    // the environments of the scene's instances
};

// The counts of one frame of a scene.
struct SceneFrameCounts {
    // Number of selected gaussians or, if exceeds_budget, of those in the coarsest cut.
    int64_t gaussians;
    float tolerance_px2;  // tolerance of the cut
    bool exceeds_budget;  // if true, nothing was drawn
    double select_seconds, draw_seconds;
    RenderCounts render;  // for a stereo frame, the sums over both pictures
    // Selected gaussians of each level. draw_model() leaves it empty.
    std::vector<int64_t> levels;

    // Adds the counts of the second picture of a stereo frame.
    void add_picture(const SceneFrameCounts& other) {
        draw_seconds += other.draw_seconds;
        render.in_frustum += other.render.in_frustum;
        render.records += other.render.records;
        render.entries += other.render.entries;
    }
};

// The instance and the cluster of the gaussian with the largest blend weight in a
// pixel.
struct ScenePick {
    int32_t instance, cluster;
    float weight;  // blend weight
    float depth;
};

namespace cpu {

// A ratio of metric to tolerance from this value on is shown as white.
constexpr float kMostShare = 2.0f;

// Draws a request: one picture per eye, or only the first eye's picture if the request
// has a given cut. `rule` is the request's rule, as changed by a pool or by the pacing
// of a budget. Throws std::out_of_range if the given cut has a pair that is not in the
// scene. If `stop` becomes true, the function returns soon, with incomplete pictures.
// `sensors` has one element per picture, or none.
SceneFrameCounts draw_scene(const HostScene& scene, const FrameRequest& request,
                            const SelectRule& rule, Span<const Picture<float>> pictures,
                            Span<const Sensor> sensors, const std::atomic<bool>* stop = nullptr);

// Draws a picture for each camera. Decisions and pixels are equal to those of
// draw_scene() for the instances that the camera sees. Each thread draws the pictures
// of some cameras. When fewer cameras than threads are left, all threads together draw
// one picture after another.
void draw_batch(const HostScene& scene, const BatchRequest& request, const HostCameras& cameras,
                Span<SceneFrameCounts> counts);

// Draws all gaussians of one model, in world coordinates. A sensor's ids name the model
// as instance 0.
SceneFrameCounts draw_model(const GaussianPlanes<float>& model, size_t count,
                            const Appearance<float>& appearance, const Camera& camera,
                            const Picture<float>& picture, const Sensor& sensor,
                            const std::atomic<bool>* stop = nullptr);

// Finds the gaussian with the largest blend weight in the first pixel of the first
// eye's window. It uses the same cut as draw_scene(). Returns false if no gaussian is
// drawn there.
bool pick_scene(const HostScene& scene, const FrameRequest& request, const SelectRule& rule,
                ScenePick& picked);

}  // namespace cpu
}  // namespace v3dg
