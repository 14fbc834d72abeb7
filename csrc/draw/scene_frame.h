#pragma once

// Frames of a scene on the host: from a request to pictures and counts.

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
    // [C][3] SH coefficients of degree 0: colours of clusters that replace the palette;
    // null: none.
    const float* cluster_sh = nullptr;
};

// A scene on the host: the tables for selection, the gaussians, and the instances.
struct HostScene {
    Span<const ClusterTable> tables;
    Span<const SceneModel> models;  // one per table
    InstanceTable instances;
    // Optional outputs of selection (see SelectInput).
    Span<const Span<uint32_t>> needs = {};
    uint32_t* last_bin = nullptr;
    Span<const ClusterRuns> runs = {};
    // For sensors that output ids: the label of each instance of the whole scene, if
    // any has one; and the ids of `instances` if these are only a part of it.
    Span<const int32_t> labels = {};
    Span<const int32_t> instance_ids = {};
};

// The cameras of a batch on the host. They have the size of the request, and belong to
// environments of the scene.
struct HostCameras {
    Span<const Camera> camera;        // [B]
    Span<const int32_t> environment;  // [B] as in EnvironmentTable
    EnvironmentTable environments;    // the environments of the scene's instances
};

// The counts of one frame.
struct SceneFrameCounts {
    // Selected gaussians. If exceeds_budget, the gaussians of the coarsest cut.
    int64_t gaussians;
    float tolerance_px2;  // tolerance of the cut
    bool exceeds_budget;  // if true, nothing was drawn
    double select_seconds, draw_seconds;
    RenderCounts render;  // sums over both pictures of a stereo frame
    // Selected gaussians of each level; not set by draw_model().
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

// The ratio of metric to tolerance that is shown as white; larger ratios look the same.
constexpr float kMostShare = 2.0f;

// Draws a request: one picture per eye, or only the first picture if the request has a
// cut. `rule` is the request's rule after changes by a pool or by the pacing of a
// budget. Throws std::out_of_range if the request's cut has a pair that is not in the
// scene. If `stop` becomes true, it returns soon, and the pictures are incomplete.
// `sensors` has one per picture, or none.
SceneFrameCounts draw_scene(const HostScene& scene, const FrameRequest& request,
                            const SelectRule& rule, Span<const Picture<float>> pictures,
                            Span<const Sensor> sensors, const std::atomic<bool>* stop = nullptr);

// Draws a picture for each camera. The decisions and the pixels are equal to those of
// draw_scene() for the instances that the camera sees. Each thread draws the pictures
// of some cameras. If the remaining cameras are fewer than the threads, all threads
// together draw one picture after another.
void draw_batch(const HostScene& scene, const BatchRequest& request, const HostCameras& cameras,
                Span<SceneFrameCounts> counts);

// Draws all gaussians of one model, in world coordinates. For the ids of a sensor, the
// model is instance 0.
SceneFrameCounts draw_model(const GaussianPlanes<float>& model, size_t count,
                            const Appearance<float>& appearance, const Camera& camera,
                            const Picture<float>& picture, const Sensor& sensor,
                            const std::atomic<bool>* stop = nullptr);

// Finds the gaussian with the largest blend weight in the first pixel of the first
// eye's window, in the cut of draw_scene(). Returns whether any gaussian is drawn
// there.
bool pick_scene(const HostScene& scene, const FrameRequest& request, const SelectRule& rule,
                ScenePick& picked);

}  // namespace cpu
}  // namespace v3dg
