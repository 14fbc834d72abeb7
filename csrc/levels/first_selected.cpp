// Compares pictures of the leaves and of level 1 at several sizes. The size with the
// smallest sum of log loss ratios determines the growth of a group's ball.

#include "levels/first_selected.h"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "base/random.h"
#include "math/solid_angle.h"
#include "math/vec.h"

namespace v3dg {

namespace {

// Limits of the growth of balls. At the default tolerance, kDefaultPx2, they correspond
// to 1.5 and 0.19 px² per gaussian.
constexpr double kLeast = 1.4, kMost = 4, kDefaultPx2 = 3;
// Median px² per gaussian at each size.
constexpr double kPx2[FirstSelected::kSizes] = {0.2, 0.5, 1.2, 3};
constexpr double kWidestPx = 2048;  // largest width of a picture
constexpr double kBorderPx = 4;     // border around the ball
constexpr double kDistance = 8;     // distance of the camera from the centre, in radii
constexpr double kShare = 0.999;    // fraction of the gaussians in the ball
// The loss of a pixel is its absolute error to the power of kPower, which approximates
// perception. A level counts as good enough if its loss is at most kAsGood times the
// loss of the leaves. This criterion agrees with FLIP.
constexpr float kPower = 0.7f;
constexpr double kAsGood = 1.15;
// Corrections for groups that are hardly visible. kLikeAll times the mean loss of all
// groups is added to both losses, so that such a group is treated like an average one.
// kOutOfSight times the mean is added to the loss of the leaves only, because errors of
// hardly visible groups matter less.
constexpr double kLikeAll = 0.2, kOutOfSight = 0.05;
// Added to losses, and minimum of footprints, to keep ratios finite.
constexpr double kNothing = 1e-9;
constexpr int kSteps = 64;  // number of sizes to try

double mean_of(const std::vector<double>& values) {
    return std::accumulate(values.begin(), values.end(), 0.0) / static_cast<double>(values.size());
}

}  // namespace

FirstSelected::FirstSelected(Span<const float> means, Span<const Ball> balls,
                             Span<const int64_t> group_offset)
    : around_(surroundings_of(means, kShare)) {
    for (size_t g = 0; g < balls.size; ++g) {
        const double part = static_cast<double>(balls[g].radius) / around_.radius;
        const auto count = static_cast<double>(group_offset[g + 1] - group_offset[g]);
        footprint_.push_back(std::max(kPi * part * part / count, kNothing) /
                             (kDistance * kDistance));
    }
    const double most = kWidestPx / 2 * std::sqrt(kDistance * kDistance - 1);
    for (size_t size = 0; size < kSizes; ++size) {
        focal_[size] = std::min(std::sqrt(kPx2[size] / median(footprint_)), most);
        of_leaves_[size].assign(balls.size, 0);
        of_level_[size].assign(balls.size, 0);
    }
}

// Cameras are evenly distributed around the ball. Each picture is shifted by another
// fraction of a pixel.
Camera FirstSelected::camera(size_t picture) const {
    const size_t side = picture % kSides;
    const double z = 1 - (2 * static_cast<double>(side) + 1) / kSides;
    const double angle = kPi * (1 + std::sqrt(5.0)) * (static_cast<double>(side) + 0.5);
    const double flat = std::sqrt(1 - z * z);
    const double outwards[3] = {flat * std::cos(angle), flat * std::sin(angle), z};
    double up[3] = {0, 0, 1}, right[3];
    cross3(up, outwards, right);  // never parallel, because no camera is straight above
    for (double& x : right) x /= flat;
    const double focal = focal_[picture / kSides];
    const double size =
        std::floor(2 * focal / std::sqrt(kDistance * kDistance - 1)) + 2 * kBorderPx;
    return camera_at(around_, kDistance, outwards, right,
                     {.fx = focal,
                      .fy = focal,
                      .cx = size / 2 + random_uniform(0, picture, 0) - 0.5,
                      .cy = size / 2 + random_uniform(0, picture, 1) - 0.5,
                      .width = size,
                      .height = size,
                      .near_depth = around_.radius});
}

void FirstSelected::add(size_t picture, Span<const float> shares, Span<const int64_t> leaf_offset) {
    std::vector<double>&of_leaves = of_leaves_[picture / kSides],
    &of_level = of_level_[picture / kSides];
    for (size_t g = 0; g < of_leaves.size(); ++g)
        for (auto i = static_cast<size_t>(leaf_offset[g]);
             i < static_cast<size_t>(leaf_offset[g + 1]); ++i) {
            of_leaves[g] += static_cast<double>(shares[3 * i]);
            of_level[g] += static_cast<double>(shares[3 * i + 1]);
        }
}

std::vector<float> FirstSelected::growth() const {
    double mean_of_leaves[kSizes], mean_of_level[kSizes];
    for (size_t size = 0; size < kSizes; ++size) {
        mean_of_leaves[size] = mean_of(of_leaves_[size]);
        mean_of_level[size] = mean_of(of_level_[size]);
    }
    std::vector<float> growth;
    for (size_t g = 0; g < footprint_.size(); ++g) {
        double log_px2_of[kSizes];
        double log_ratio[kSizes];  // log of the loss of level 1 over the largest
                                   // acceptable loss
        for (size_t size = 0; size < kSizes; ++size) {
            log_px2_of[size] = std::log(footprint_[g] * focal_[size] * focal_[size]);
            const double of_level = of_level_[size][g] + kLikeAll * mean_of_level[size] + kNothing;
            const double of_leaves =
                of_leaves_[size][g] + (kLikeAll + kOutOfSight) * mean_of_leaves[size] + kNothing;
            log_ratio[size] = std::log(of_level / of_leaves / kAsGood);
        }
        // Begin at the smallest size, and choose the size up to which the sum of log
        // ratios is smallest.
        double sum = 0, least = INFINITY, first = kMost;
        for (int step = 0; step < kSteps; ++step) {
            const double times = kMost * std::pow(kLeast / kMost, step / (kSteps - 1.0));
            const double log_px2 = std::log(kDefaultPx2 / (times * times));
            const auto above = static_cast<size_t>(
                std::upper_bound(log_px2_of, log_px2_of + kSizes, log_px2) - log_px2_of);
            const size_t next = std::clamp<size_t>(above, 1, kSizes - 1), last = next - 1;
            const double width = log_px2_of[next] - log_px2_of[last];
            const double part =
                width > 0 ? std::clamp((log_px2 - log_px2_of[last]) / width, 0.0, 1.0) : 0.0;
            sum += log_ratio[last] + part * (log_ratio[next] - log_ratio[last]);
            if (sum < least) {
                least = sum;
                first = times;
            }
        }
        growth.push_back(static_cast<float>(first));
    }
    return growth;
}

void losses_of_pixels(const PictureColors& colors, size_t width, size_t height,
                      Span<float> losses) {
    constexpr size_t kSamples = FirstSelected::kSamples;
    std::vector<float> truth(3 * width * height), off(truth.size()), across(truth.size());
    for (size_t y = 0; y < kSamples * height; ++y)
        for (size_t i = 0; i < 3 * kSamples * width; ++i)
            truth[3 * (y / kSamples * width + i / (3 * kSamples)) + i % 3] +=
                std::min(colors.truth[3 * kSamples * width * y + i], 1.0f) / (kSamples * kSamples);
    // An error in a single pixel is hardly visible, so errors are blurred over adjacent
    // pixels. Indices may wrap around, because the border of a picture is empty.
    const auto shared = [](const std::vector<float>& from, size_t i, size_t step) {
        const float before = i < step ? 0.0f : from[i - step];
        return 0.25f * (before + 2 * from[i] + (i + step < from.size() ? from[i + step] : 0.0f));
    };
    std::fill(losses.begin(), losses.end(), 0.0f);
    size_t which = 0;
    for (const Span<const float>& drawn : {colors.of_leaves, colors.of_level}) {
        for (size_t i = 0; i < off.size(); ++i) off[i] = std::min(drawn[i], 1.0f) - truth[i];
        for (size_t i = 0; i < off.size(); ++i) across[i] = shared(off, i, 3);
        for (size_t i = 0; i < width * height; ++i) {
            float sum = 0;
            for (size_t c = 0; c < 3; ++c) sum += std::fabs(shared(across, 3 * i + c, 3 * width));
            losses[3 * i + which] = std::pow(sum / 3, kPower);
        }
        ++which;
    }
}

}  // namespace v3dg
