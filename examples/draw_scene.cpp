// Draws a small scene with the C++ core, without Python: two instances of a bundle with one level.
// One call selects and draws them, and the picture is written as a .ppm file. Build the example
// with `cmake --build build/cpu --target draw_scene`.

#include <cmath>
#include <cstdio>
#include <vector>

#include "draw/model.h"
#include "draw/scene_frame.h"
#include "math/sh.h"

using namespace v3dg;

constexpr size_t kGaussians = 2000, kClusterSize = 250, kClusters = kGaussians / kClusterSize;
constexpr int kWidth = 320, kHeight = 240;

// Gaussians on a spiral around a unit sphere, in clusters that are ordered from pole to pole.
struct Globe {
    std::vector<float> means, quats, scales, opacities, sh;

    Globe() {
        for (size_t i = 0; i < kGaussians; ++i) {
            const double z = 1 - (2 * i + 1) / double(kGaussians), turn = 2.4 * i,
                         ring = std::sqrt(1 - z * z);
            for (const double x : {ring * std::cos(turn), ring * std::sin(turn), z}) {
                means.push_back(float(x));
                scales.push_back(0.04f);
                sh.push_back(float(0.4 * x / kShBase0));
            }
            for (const float q : {1.0f, 0.0f, 0.0f, 0.0f}) quats.push_back(q);
            opacities.push_back(0.9f);
        }
    }
    GaussianRows<const float> rows() const {
        return {.means = means.data(),
                .quats = quats.data(),
                .scales = scales.data(),
                .opacities = opacities.data(),
                .sh = sh.data(),
                .size = kGaussians,
                .sh_degree = 0};
    }
};

int main(int num_arguments, char** arguments) {
    const Globe globe;
    const Model<float> model(globe.rows());

    // The bundle has one level and no groups, so every cluster is a leaf and a root.
    std::vector<Box> boxes(kClusters, Box{{-1.2f, -1.2f, -1.2f}, {1.2f, 1.2f, 1.2f}});
    const std::vector<int32_t> no_group(kClusters, -1);
    const std::vector<float> filters(kClusters, 0.0f);
    const std::vector<uint8_t> antialiased(kClusters, 0);
    std::vector<int64_t> offset;
    for (size_t c = 0; c <= kClusters; ++c)
        offset.push_back(static_cast<int64_t>(c * kClusterSize));
    ClusterTable clusters{};
    clusters.own_group = {no_group.data(), kClusters};
    clusters.parent_group = {no_group.data(), kClusters};
    clusters.box = {boxes.data(), kClusters};
    clusters.offset = {offset.data(), offset.size()};
    const HostTable table(clusters, {{filters.data(), kClusters}, {antialiased.data(), kClusters}});

    const std::vector<int32_t> bundle_of_instance{0, 0};
    const std::vector<double> position{-1.3, 0, 0, 1.3, 0, 0}, quaternion{1, 0, 0, 0, 1, 0, 0, 0},
        scale{1, 0.7};
    const std::vector<float> importance{1, 1};
    const SceneModel drawn{
        .planes = &model.planes(), .appearance = table.appearance(), .palette = {}};
    const InstanceTable instances{.bundle = {bundle_of_instance.data(), 2},
                                  .position = {position.data(), 6},
                                  .quaternion = {quaternion.data(), 8},
                                  .scale = {scale.data(), 2},
                                  .importance = {importance.data(), 2}};
    const HostScene scene{
        .tables = {&table.table(), 1}, .models = {&drawn, 1}, .instances = instances};

    // The camera is at (0, 0, -6) and looks along z.
    Camera camera{};
    const double viewmat[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 6, 0, 0, 0, 1};
    for (int row = 0; row < 3; ++row) {
        for (int k = 0; k < 3; ++k) camera.rotation[3 * row + k] = viewmat[4 * row + k];
        camera.translation[row] = viewmat[4 * row + 3];
    }
    eye_of(viewmat, camera.eye);
    camera.fx = camera.fy = 400;
    camera.cx = kWidth / 2;
    camera.cy = kHeight / 2;
    camera.x1 = camera.width = kWidth;
    camera.y1 = camera.height = kHeight;
    camera.near_depth = 0.01;

    std::vector<float> color(3 * kWidth * kHeight), alpha(kWidth * kHeight);
    const Picture<float> picture{.window = {0, 0, kWidth, kHeight},
                                 .background = {0.1f, 0.1f, 0.15f},
                                 .color = color.data(),
                                 .alpha = alpha.data(),
                                 .depth = nullptr};
    SelectRule rule{};
    rule.tolerance_px2 = 3.0f;
    const SceneFrameCounts counts = cpu::draw_scene(
        scene, {.eyes = camera, .rule = rule, .shade = {}}, rule, {&picture, 1}, {});
    std::printf("%lld gaussians selected, %llu in the frustum\n",
                static_cast<long long>(counts.gaussians),
                static_cast<unsigned long long>(counts.render.in_frustum));

    std::FILE* file = std::fopen(num_arguments > 1 ? arguments[1] : "draw_scene.ppm", "wb");
    if (file == nullptr) return 1;
    std::fprintf(file, "P6\n%d %d\n255\n", kWidth, kHeight);
    for (const float value : color)
        std::fputc(static_cast<int>(255 * std::fmin(std::fmax(value, 0), 1) + 0.5f), file);
    return std::fclose(file);
}
