// Chooses views of random cuts of a bundle. The index of a view determines a size, a
// camera, and a window in which cuts are compared. The shares of gaussians in its cuts
// depend on the size.

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

constexpr double kNarrowestPx = 8, kMostPx = 1 << 15;  // limits of the width and height
                                                       // of a picture, px
// The px² per gaussian at the native size of a cut. At this size, the default tolerance
// selects the cut.
constexpr double kNativePx2 = 2;
// The range of a picture's size, relative to the native size of its cut: the smallest
// value, and the number of octaves.
constexpr double kLeastSize = 0.18, kOctavesOfSize = 5.75;
constexpr double kDistance = 2.5;  // distance of the camera from the centre, in radii
constexpr double kNear = 0.01;     // near depth, in radii
constexpr int kMostTries = 16;     // number of attempts to find a gaussian inside the
                                   // picture
constexpr int kMostTriesOfShare = 64;
// An upper bound on how many random numbers one view, or one of its shares, needs.
constexpr uint64_t kRandomNumbersOfView = 1024;
constexpr double kMostOfAsset = 0.7;  // largest share of the asset's gaussians in a cut
// Fraction of the gaussians that CutPictures::ball contains. The ball ignores outliers.
constexpr double kShare = 0.99;

// The random numbers of one view.
class Random {
  public:
    Random(uint64_t seed, uint64_t stream, uint64_t counter)
        : seed_(seed), stream_(stream), counter_(counter) {}
    double uniform() { return random_uniform(seed_, stream_, counter_++); }
    void direction(double out[3]) {
        const double z = 2 * uniform() - 1, angle = 2 * kPi * uniform(),
                     flat = std::sqrt(1 - z * z);
        out[0] = flat * std::cos(angle);
        out[1] = flat * std::sin(angle);
        out[2] = z;
    }

  private:
    uint64_t seed_, stream_, counter_;
};

// Returns a camera that looks at the centre of the ball from a random direction. Its
// picture is a single pixel.
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
    const double focal = std::sqrt(kDistance * kDistance - 1) / 2;  // the ball fills the picture
    return camera_at(pictures.ball, kDistance, outwards, right,
                     {.fx = focal,
                      .fy = focal,
                      .cx = 0.5,
                      .cy = 0.5,
                      .width = 1,
                      .height = 1,
                      .near_depth = kNear * pictures.ball.radius});
}

// Returns the camera with a scaled picture whose size is rounded up to whole pixels.
Camera resized(const Camera& camera, double scale) {
    const Camera scaled = camera.scaled(scale);
    const double width = std::ceil(scaled.width);
    const double height = std::ceil(scaled.height);
    return scaled.cropped(-(width - scaled.width) / 2, -(height - scaled.height) / 2, width,
                          height);
}

// Returns the camera with its picture shifted by a random fraction of a pixel, and
// enlarged if it is narrow.
Camera on_screen(const Camera& camera, Random& random) {
    const double width = std::max(camera.width, kNarrowestPx),
                 height = std::max(camera.height, kNarrowestPx);
    const double left = (width - camera.width) / 2 + random.uniform() - 0.5;
    const double above = (height - camera.height) / 2 + random.uniform() - 0.5;
    return camera.cropped(-left, -above, width, height);
}

// Returns a window of the picture around a random gaussian. CutPictures::weight holds
// the prefix sums of the gaussians' probabilities.
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
        if (!(camera.depth_of(p) > camera.near_depth)) continue;
        double x, y;
        camera.to_pixel(camera.linearized(camera.limits(), p), p, x, y);
        if (!(x >= 0 && x < camera.width && y >= 0 && y < camera.height)) continue;
        at[0] = x;
        at[1] = y;
        break;
    }
    const double width = std::min(camera.width, widest_px);
    const double height = std::min(camera.height, widest_px);
    const double left = std::clamp(std::round(at[0] - width / 2), 0.0, camera.width - width);
    const double top = std::clamp(std::round(at[1] - height / 2), 0.0, camera.height - height);
    return camera.cropped(left, top, width, height);
}

// The tables of a scene that has a single, untransformed instance of a bundle.
struct OneInstance {
    const int32_t bundle = 0;
    const double position[3] = {}, quaternion[4] = {1, 0, 0, 0}, scale = 1;
    const float importance = 1;

    Pose pose() const { return {position, quaternion, scale}; }
    InstanceTable table() const {
        return {.bundle = {&bundle, 1},
                .position = {position, 3},
                .quaternion = {quaternion, 4},
                .scale = {&scale, 1},
                .importance = {&importance, 1}};
    }
};

SelectOutput selected(const ClusterTable& table, const Camera& camera, const SelectRule& rule) {
    const OneInstance instance;
    SelectOutput out;
    cpu::select(
        {.bundles = {&table, 1}, .instances = instance.table(), .eyes = Eyes(camera), .rule = rule},
        out);
    return out;
}

// Returns the cut of a picture for each budget.
std::vector<BudgetCut> cuts_within(const ClusterTable& table, const Camera& camera,
                                   const SelectRule& rule, Span<const uint64_t> budgets) {
    const OneInstance instance;
    std::vector<BudgetCut> cuts(budgets.size);
    cpu::choose_tolerances(
        {.bundles = {&table, 1}, .instances = instance.table(), .eyes = Eyes(camera), .rule = rule},
        budgets, {cuts.data(), cuts.size()});
    return cuts;
}

// Converts a uniform random number to the share of the gaussians in a cut.
double share_of_part(const CutPictures& pictures, double part) {
    const auto all = static_cast<double>(pictures.weight.size());
    return pictures.most * std::pow(pictures.least / pictures.most, part * part) / all;
}

// Returns the share of gaussians in cut `cut` of a view. First and later cuts have the
// same distribution of shares, except that later cuts are limited to shares for which
// the size of the picture is allowed.
double share_of_cut(const CutPictures& pictures, const AssetView& view, uint64_t number,
                    size_t cut) {
    if (cut == 0) return view.share;
    Random random(pictures.seed, number, kRandomNumbersOfView * cut);
    for (int tries = 0; tries < kMostTriesOfShare; ++tries) {
        const double share = share_of_part(pictures, random.uniform());
        const double octaves = std::log2(view.size / std::sqrt(share) / kLeastSize);
        if (octaves >= 0 && octaves < kOctavesOfSize) return share;
    }
    return view.share;
}

// The parameters of a comparison: the largest side of the window, and the samples per
// pixel side of the asset's picture. Large gaussians make a picture smooth, so it needs
// fewer samples. `size` is relative to the asset's native size.
struct Comparison {
    double widest_px;
    int samples;
};
Comparison comparison_of(double size, double longer_px) {
    if (size >= 2) return {kWidestWindowPx, 2};
    if (size >= 1) return {kWidestWindowPx, 3};
    return {kWidestWindowPx / 2, longer_px <= 128 ? 8 : 4};
}

}  // namespace

double median(std::vector<double> values) {
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    if (values.size() % 2 > 0) return *middle;
    return (*std::max_element(values.begin(), middle) + *middle) / 2;
}

Camera camera_at(const Surroundings& ball, double distance, const double outwards[3],
                 const double right[3], const Pinhole<double>& projection) {
    double down[3];
    cross3(right, outwards, down);
    Camera camera = with_projection(intrinsics_of(projection));
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
    // Weight gaussians by their approximate size on screen: the mean of the two larger
    // scales, times the opacity.
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

AssetView asset_view(const CutPictures& pictures, uint64_t number) {
    Random random(pictures.seed, number, 0);
    AssetView view{};
    view.share = share_of_part(pictures, random.uniform());
    view.size = kLeastSize * std::exp2(kOctavesOfSize * random.uniform()) * std::sqrt(view.share);
    view.num_gaussians = static_cast<double>(pictures.weight.size());
    const bool has_cameras = pictures.cameras.size > 0;
    Camera camera;
    if (has_cameras) {
        const size_t n = pictures.cameras.size;
        camera = pictures.cameras[static_cast<size_t>(random.uniform() * static_cast<double>(n))];
        view.num_gaussians =
            static_cast<double>(selected(pictures.table, camera, SelectRule{}).num_gaussians);
    } else {
        camera = camera_around(pictures, random);
    }
    const double longer = std::max(camera.width, camera.height);
    const double area_px2 = view.size * view.size * kNativePx2 * view.num_gaussians;
    const double scale = std::sqrt(area_px2 / (camera.width * camera.height));
    const double longer_px = std::clamp(longer * scale, has_cameras ? kNarrowestPx : 0.0, kMostPx);
    view.picture = resized(camera, longer_px / longer);
    if (!has_cameras) view.picture = on_screen(view.picture, random);
    const Comparison comparison = comparison_of(view.size, longer_px);
    view.samples = comparison.samples;
    view.window = window_of(view.picture, comparison.widest_px, pictures, random);
    return view;
}

std::vector<SelectRule> cuts_of_view(const CutPictures& pictures, const AssetView& view,
                                     uint64_t number, size_t count) {
    std::vector<uint64_t> budgets;
    for (size_t cut = 0; cut < count; ++cut)
        budgets.push_back(static_cast<uint64_t>(
            std::ceil(share_of_cut(pictures, view, number, cut) * view.num_gaussians)));
    SelectRule whole{};
    whole.culls = pictures.cameras.size > 0;
    const std::vector<BudgetCut> cuts =
        cuts_within(pictures.table, view.picture, whole, {budgets.data(), budgets.size()});
    const Span<const int32_t>& levels = pictures.table.level;
    const int32_t coarsest = levels.size > 0 ? levels[levels.size - 1] : 0;
    std::vector<SelectRule> rules;
    for (size_t cut = 0; cut < count; ++cut) {
        SelectRule rule = whole;
        BudgetCut found = cuts[cut];
        // If the camera is inside a group's ball, the group is refined at any
        // tolerance. Then only the coarsest cut may meet the budget, with far fewer
        // gaussians than allowed. In this case, exclude the finest levels until a cut
        // has a finite tolerance.
        while (std::isinf(found.tolerance_px2) &&
               2 * found.num_gaussians < static_cast<int64_t>(budgets[cut]) &&
               rule.min_level < coarsest) {
            ++rule.min_level;
            found = cuts_within(pictures.table, view.picture, rule, {&budgets[cut], 1})[0];
        }
        rule.tolerance_px2 = found.fits ? found.tolerance_px2 : FLT_MAX;
        rule.culls = true;
        rules.push_back(rule);
    }
    return rules;
}

std::vector<int32_t> clusters_in_window(const CutPictures& pictures, const AssetView& view,
                                        const SelectRule& rule) {
    return selected(pictures.table, view.window, rule).cluster;
}

InstanceView view_of_window(const ClusterTable& table, const Camera& window) {
    const OneInstance instance;
    return view_from_instance(Eyes(window), sides_of_eyes(Eyes(window), table.pad_px),
                              axes_of_instance(window, instance.pose()), instance.pose(),
                              instance.importance);
}

}  // namespace v3dg
