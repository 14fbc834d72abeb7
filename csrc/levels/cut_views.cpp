// Views of random cuts of a bundle. Each follows from its number: a share of the gaussians, a size,
// a camera, the cut of that budget, and a window in which it is compared.

#include "levels/cut_views.h"

#include <algorithm>
#include <cfloat>
#include <cmath>

#include "base/random.h"
#include "math/solid_angle.h"
#include "math/vec.h"
#include "select/select.h"

namespace v3dg {

namespace {

constexpr double kNarrowestPx = 8, kMostPx = 1 << 15;  // limits of a picture's side, px
// px² a gaussian at which a cut is selected at the default tolerance: the native size.
constexpr double kNativePx2 = 2;
// The range of a picture's side, relative to the native size of its cut.
constexpr double kLeastSize = 0.18, kOctavesOfSize = 5.75;
constexpr double kDistance = 2.5;     // distance from the centre, in radii
constexpr double kNear = 0.01;        // radii
constexpr int kMostTries = 16;        // attempts to find a gaussian that a picture shows
constexpr double kMostOfAsset = 0.7;  // largest share of the asset's gaussians in a cut
// The share of the gaussians within the radius; the rest may float far away.
constexpr double kShare = 0.99;

// The random numbers of one view.
class Random {
  public:
    Random(uint64_t seed, uint64_t stream) : seed_(seed), stream_(stream) {}
    double uniform() { return random_uniform(seed_, stream_, counter_++); }
    void direction(double out[3]) {
        const double z = 2 * uniform() - 1, angle = 2 * kPi * uniform(),
                     flat = std::sqrt(1 - z * z);
        out[0] = flat * std::cos(angle);
        out[1] = flat * std::sin(angle);
        out[2] = z;
    }

  private:
    uint64_t seed_, stream_, counter_ = 0;
};

// Returns a camera that looks at the centre from anywhere around it; its picture is one px wide.
Camera camera_around(const CutPictures& pictures, Random& random) {
    double outwards[3], up[3], right[3];
    random.direction(outwards);
    double length = 0;
    while (length < 1e-3) {
        random.direction(up);
        cross3(up, outwards, right);
        length = std::sqrt(dot3(right, right));
    }
    for (double& x : right) x /= length;
    Camera camera = camera_at(pictures.ball, kDistance, outwards, right);
    // The ball fills the picture.
    camera.fx = camera.fy = std::sqrt(kDistance * kDistance - 1) / 2;
    camera.cx = camera.cy = 0.5;
    camera.width = camera.height = 1;
    camera.near_depth = kNear * pictures.ball.radius;
    return camera;
}

// Returns the camera with its picture scaled.
Camera resized(Camera camera, double scale) {
    const double width = std::ceil(scale * camera.width), height = std::ceil(scale * camera.height);
    camera.cx = scale * camera.cx + (width - scale * camera.width) / 2;
    camera.cy = scale * camera.cy + (height - scale * camera.height) / 2;
    camera.fx *= scale;
    camera.fy *= scale;
    camera.width = camera.x1 = width;
    camera.height = camera.y1 = height;
    camera.x0 = camera.y0 = 0;
    return camera;
}

// Returns the camera with its picture shifted to a random place among the pixels of a screen, and
// widened where it is narrow.
Camera on_screen(Camera camera, Random& random) {
    const double width = std::max(camera.width, kNarrowestPx),
                 height = std::max(camera.height, kNarrowestPx);
    camera.cx += (width - camera.width) / 2 + random.uniform() - 0.5;
    camera.cy += (height - camera.height) / 2 + random.uniform() - 0.5;
    camera.width = camera.x1 = width;
    camera.height = camera.y1 = height;
    return camera;
}

// Returns a window of the picture around a random gaussian. A gaussian that is twice as large in
// the asset is chosen twice as often.
Camera window_of(const Camera& camera, double widest_px, const CutPictures& pictures,
                 Random& random) {
    double at[2] = {camera.width / 2, camera.height / 2};
    for (int tries = 0; tries < kMostTries; ++tries) {
        const std::vector<double>& weight = pictures.weight;
        const auto chosen =
            std::upper_bound(weight.begin(), weight.end(), random.uniform() * weight.back());
        const auto i = std::min(static_cast<size_t>(chosen - weight.begin()), weight.size() - 1);
        double p[3];
        for (int row = 0; row < 3; ++row) {
            p[row] = camera.translation[row];
            for (int k = 0; k < 3; ++k)
                p[row] +=
                    camera.rotation[3 * row + k] * static_cast<double>(pictures.means[3 * i + k]);
        }
        if (!(p[2] > camera.near_depth)) continue;
        const double x = camera.fx * p[0] / p[2] + camera.cx,
                     y = camera.fy * p[1] / p[2] + camera.cy;
        if (!(x >= 0 && x < camera.width && y >= 0 && y < camera.height)) continue;
        at[0] = x;
        at[1] = y;
        break;
    }
    Camera window = camera;
    window.width = window.x1 = std::min(camera.width, widest_px);
    window.height = window.y1 = std::min(camera.height, widest_px);
    window.cx -= std::clamp(std::round(at[0] - window.width / 2), 0.0, camera.width - window.width);
    window.cy -=
        std::clamp(std::round(at[1] - window.height / 2), 0.0, camera.height - window.height);
    return window;
}

SelectOutput selected(const ClusterTable& table, const Camera& camera, const SelectRule& rule) {
    const int32_t bundle = 0;
    const double position[3] = {}, quaternion[4] = {1, 0, 0, 0}, scale = 1;
    const float importance = 1;
    const InstanceTable instance{.bundle = {&bundle, 1},
                                 .position = {position, 3},
                                 .quaternion = {quaternion, 4},
                                 .scale = {&scale, 1},
                                 .importance = {&importance, 1}};
    const SelectInput in{
        .bundles = {&table, 1}, .instances = instance, .eyes = Eyes(camera), .rule = rule};
    SelectOutput out;
    cpu::select(in, out);
    return out;
}

// The way in which a picture is compared: the largest side of the window, and the samples of a side
// of a pixel of the asset. The larger its gaussians appear, the smoother the picture is; small
// pictures cost little. `size` is that of the picture, relative to the asset's native size.
struct Comparison {
    double widest_px;
    int samples;
};
Comparison comparison_of(double size, double longer_px) {
    if (size >= 2) return {512, 2};
    if (size >= 1) return {512, 3};
    return {256, longer_px <= 128 ? 8 : 4};
}

}  // namespace

double median(std::vector<double> values) {
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    if (values.size() % 2 > 0) return *middle;
    return (*std::max_element(values.begin(), middle) + *middle) / 2;
}

Camera camera_at(const Surroundings& ball, double distance, const double outwards[3],
                 const double right[3]) {
    double down[3];
    cross3(right, outwards, down);
    Camera camera{};
    for (int k = 0; k < 3; ++k) {
        camera.rotation[k] = right[k];
        camera.rotation[3 + k] = down[k];
        camera.rotation[6 + k] = -outwards[k];
        camera.eye[k] = ball.center[k] + distance * ball.radius * outwards[k];
    }
    for (int row = 0; row < 3; ++row)
        camera.translation[row] = -dot3(camera.rotation + 3 * row, camera.eye);
    return camera;
}

Surroundings surroundings_of(Span<const float> means, double share) {
    Surroundings ball{};
    std::vector<double> values(means.size / 3);
    for (size_t k = 0; k < 3; ++k) {
        for (size_t i = 0; i < values.size(); ++i)
            values[i] = static_cast<double>(means[3 * i + k]);
        ball.center[k] = median(values);
    }
    for (size_t i = 0; i < values.size(); ++i) {
        double d[3];
        for (size_t k = 0; k < 3; ++k)
            d[k] = static_cast<double>(means[3 * i + k]) - ball.center[k];
        values[i] = std::sqrt(dot3(d, d));
    }
    const auto farthest =
        static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
    std::nth_element(values.begin(), values.begin() + farthest, values.end());
    ball.radius = values[static_cast<size_t>(farthest)];
    if (!(ball.radius > 0)) ball.radius = 1;
    return ball;
}

CutPictures pictures_of_cuts(const ClusterTable& table, const GaussianRows<const float>& asset,
                             Span<const Camera> cameras, uint64_t seed) {
    const Span<const float> means{asset.means, 3 * asset.size};
    CutPictures pictures{.table = table,
                         .means = means,
                         .cameras = cameras,
                         .seed = seed,
                         .most = 0,
                         .least = 0,
                         .weight = {},
                         .ball = surroundings_of(means, kShare)};
    for (const int32_t c : table.top_cluster)
        pictures.least += static_cast<double>(table.num_gaussians(static_cast<size_t>(c)));
    pictures.least = std::max(pictures.least, 1.0);
    pictures.most = std::max(kMostOfAsset * static_cast<double>(asset.size), pictures.least);
    // A gaussian that is twice as large is looked at twice as often.
    double sum = 0;
    for (size_t i = 0; i < asset.size; ++i) {
        double scale[3];
        for (size_t k = 0; k < 3; ++k) scale[k] = static_cast<double>(asset.scales[3 * i + k]);
        std::sort(scale, scale + 3);
        sum += static_cast<double>(asset.opacities[i]) * std::sqrt(scale[1] * scale[2]);
        pictures.weight.push_back(sum);
    }
    return pictures;
}

CutView cut_view(const CutPictures& pictures, uint64_t number) {
    Random random(pictures.seed, number);
    const double part = random.uniform();
    // Gaussians of a picture without levels.
    double all = static_cast<double>(pictures.weight.size());
    const double share =
        pictures.most * std::pow(pictures.least / pictures.most, part * part) / all;
    const double size = kLeastSize * std::exp2(kOctavesOfSize * random.uniform());
    Camera camera;
    SelectRule rule{};
    rule.culls = pictures.cameras.size > 0;
    if (rule.culls) {
        const size_t n = pictures.cameras.size;
        camera = pictures.cameras[static_cast<size_t>(random.uniform() * static_cast<double>(n))];
        all = static_cast<double>(selected(pictures.table, camera, rule).num_gaussians);
    } else {
        camera = camera_around(pictures, random);
    }
    const double longer = std::max(camera.width, camera.height);
    const double area_px2 = size * size * kNativePx2 * share * all;
    const double scale = std::sqrt(area_px2 / (camera.width * camera.height));
    const double longer_px = std::clamp(longer * scale, rule.culls ? kNarrowestPx : 0.0, kMostPx);
    camera = resized(camera, longer_px / longer);
    if (!rule.culls) camera = on_screen(camera, random);
    rule.budget = static_cast<uint64_t>(std::ceil(share * all));
    SelectOutput whole = selected(pictures.table, camera, rule);
    // A camera inside of groups refines these at any tolerance, and only the coarsest clusters meet
    // a budget below what remains of them. Then coarser levels alone are used.
    const Span<const int32_t>& levels = pictures.table.level;
    const int32_t coarsest = levels.size > 0 ? levels[levels.size - 1] : 0;
    while (std::isinf(whole.tolerance_px2) &&
           2 * whole.num_gaussians < static_cast<int64_t>(rule.budget) &&
           rule.min_level < coarsest) {
        ++rule.min_level;
        whole = selected(pictures.table, camera, rule);
    }
    rule.budget = kNoBudget;
    rule.tolerance_px2 = whole.fits_budget ? whole.tolerance_px2 : FLT_MAX;
    rule.culls = true;
    const Comparison comparison = comparison_of(size * std::sqrt(share), longer_px);
    const Camera window = window_of(camera, comparison.widest_px, pictures, random);
    return {window, selected(pictures.table, window, rule).cluster, comparison.samples};
}

}  // namespace v3dg
