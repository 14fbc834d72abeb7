#pragma once

// Formulas of a fit, shared by the CPU and CUDA: the views of a group, the parameters
// that Adam updates, and the step sizes.

#include <numeric>

#include "base/random.h"
#include "fit_group/fit_group.h"
#include "math/adam.h"
#include "math/solid_angle.h"
#include "math/ssim.h"
#include "project/project_math.h"

namespace v3dg {

// The ratio of focal length to image size in the paper's code, which uses 88.9 px for
// 64 px.
constexpr double kFocalPerSize = 88.9 / 64;
// The width of the border around the ball. It is needed because gaussians extend beyond
// the ball.
constexpr double kMarginPx = 2.5;
// Number of held-out views. No step uses them; they are used to compare the initial
// values with the result.
constexpr int kHeldOutViews = 8;

// Multiplies two 3 x 3 matrices in row-major order.
V3DG_HD V3DG_INLINE void multiply(const double a[9], const double b[9], double out[9]) {
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            out[3 * i + k] = a[3 * i] * b[k] + a[3 * i + 1] * b[3 + k] + a[3 * i + 2] * b[6 + k];
}

// Computes a uniformly random rotation from three uniform numbers (Shoemake 1992).
V3DG_HD V3DG_INLINE void random_rotation(double u0, double u1, double u2, double r[9]) {
    const double a = sqrt_of(1 - u0), b = sqrt_of(u0), s = 2 * kPi * u1, t = 2 * kPi * u2;
    const double x = a * ::sin(s), y = a * ::cos(s), z = b * ::sin(t), w = b * ::cos(t);
    const double quat[4] = {w, x, y, z};
    rotation_of_quat(quat, 2.0, r);  // exactly 2, because the quaternion has length 1
}

// The size of a group's picture, px, if config.image_size is 0.
struct FitSize {
    double focal, side;  // `side` is a multiple of 4 px
};

V3DG_HD V3DG_INLINE FitSize size_of_group(const FitConfig& config, const FitGroup& group) {
    // `focal` is the focal length at which the ball's footprint (select/footprint.h)
    // has the area px2_per_gaussian for each gaussian.
    const double x2 = 1 / (static_cast<double>(config.distance) * config.distance);
    const double focal = sqrt_of(static_cast<double>(group.count) * config.px2_per_gaussian /
                                 solid_angle_of_ball(x2));
    const double radius_px = focal * sqrt_of(x2 / (1 - x2));
    return {focal, 4 * ::ceil((radius_px + kMarginPx) / 2)};
}

// Returns view `index` of a group. The fixed views form a randomly rotated lattice on
// the sphere. The held-out views have the next indices and form another lattice.
// Without fixed views, each view has a uniformly random direction.
V3DG_HD V3DG_INLINE FitView view_of_index(const FitConfig& config, const FitGroup& group,
                                          uint64_t index) {
    const auto uniform = [&](uint64_t counter) {
        return random_uniform(config.seed, group.stream, counter);
    };
    double rotation[9];
    if (config.num_views > 0) {
        // A Fibonacci lattice of directions. Each direction has a random roll, and the
        // whole lattice is rotated randomly.
        double lattice[9], turn[9];
        const auto num_fixed = static_cast<uint64_t>(config.num_views);
        const bool is_held_out = index >= num_fixed;
        const auto place = static_cast<double>(is_held_out ? index - num_fixed : index);
        const double z = 1 - (2 * place + 1) / (is_held_out ? kHeldOutViews : config.num_views),
                     r = sqrt_of(max_of(0.0, 1 - z * z));
        const double angle = place * kPi * (3 - sqrt_of(5.0)),
                     roll = 2 * kPi * uniform(16 + 3 * index);
        const double forward[3] = {r * ::cos(angle), r * ::sin(angle), z};
        const double side[3] = {-::sin(angle), ::cos(angle), 0};
        const double up[3] = {forward[1] * side[2] - forward[2] * side[1],
                              forward[2] * side[0] - forward[0] * side[2],
                              forward[0] * side[1] - forward[1] * side[0]};
        for (int k = 0; k < 3; ++k) {
            lattice[k] = ::cos(roll) * side[k] + ::sin(roll) * up[k];
            lattice[3 + k] = ::cos(roll) * up[k] - ::sin(roll) * side[k];
            lattice[6 + k] = forward[k];
        }
        const uint64_t turned = is_held_out ? 3 : 0;
        random_rotation(uniform(turned), uniform(turned + 1), uniform(turned + 2), turn);
        multiply(lattice, turn, rotation);
    } else {
        // The counters for the rotation must differ from those for the shift of the
        // picture.
        const uint64_t base = (uint64_t(1) << 63) + 4 * index;
        random_rotation(uniform(base), uniform(base + 1), uniform(base + 2), rotation);
    }

    FitView view;
    for (int i = 0; i < 9; ++i) view.rotation[i] = static_cast<float>(rotation[i]);
    double focal, shift_x = 0, shift_y = 0;
    if (config.image_size > 0) {
        view.size = config.image_size;
        focal = kFocalPerSize * config.image_size;
    } else {
        const FitSize wanted = size_of_group(config, group);
        focal = wanted.focal;
        view.size = static_cast<int>(wanted.side);
        shift_x = uniform(16 + 3 * index + 1) - 0.5;
        shift_y = uniform(16 + 3 * index + 2) - 0.5;
    }
    view.focal = static_cast<float>(focal);
    view.cx = static_cast<float>(view.size / 2.0 + shift_x);
    view.cy = static_cast<float>(view.size / 2.0 + shift_y);
    return view;
}

// Fixed views are visited repeatedly, in steps of `stride`. The stride is coprime to
// the number of fixed views, so that all of them are visited, and consecutive views are
// far apart. Without fixed views, each visit has a view of its own.
inline uint64_t visiting_stride(const FitConfig& config) {
    const auto num_views = static_cast<uint64_t>(config.num_views);
    uint64_t stride = 29;
    while (num_views > 1 && std::gcd(stride, num_views) > 1) ++stride;
    return stride;
}
V3DG_HD inline uint64_t visited_view(const FitConfig& config, uint64_t stride, uint64_t visit) {
    return config.num_views > 0 ? visit * stride % static_cast<uint64_t>(config.num_views) : visit;
}

// Returns the index of a held-out view. Without fixed views, the index is beyond those
// that steps can reach.
V3DG_HD inline uint64_t held_out_view(const FitConfig& config, int i) {
    return config.num_views > 0 ? static_cast<uint64_t>(config.num_views + i) : ~uint64_t(0) - i;
}

// The pictures of a group are numbered. First come those of its fixed views or, without
// fixed views, of the views of all steps. The pictures of the held-out views follow.
// These functions return the number of pictures before the held-out ones, the number of
// all pictures, and the view of a picture.
V3DG_HD inline uint64_t num_fitted_pictures(const FitConfig& config) {
    return config.num_views > 0 ? static_cast<uint64_t>(config.num_views)
                                : static_cast<uint64_t>(config.steps) * config.views_per_step;
}
V3DG_HD inline uint64_t num_pictures(const FitConfig& config) {
    return num_fitted_pictures(config) + kHeldOutViews;
}
V3DG_HD inline uint64_t view_of_picture(const FitConfig& config, uint64_t picture) {
    const uint64_t num_fitted = num_fitted_pictures(config);
    return picture < num_fitted ? picture
                                : held_out_view(config, static_cast<int>(picture - num_fitted));
}

// Returns the transform from the world to a view in which the ball has radius 1.
V3DG_HD V3DG_INLINE ModelView<float> view_of_world(const FitConfig& config, const float center[3],
                                                   float radius, const FitView& view) {
    double linear[9], translation[3] = {0, 0, config.distance}, eye[3];
    for (int i = 0; i < 3; ++i) {
        for (int k = 0; k < 3; ++k) {
            linear[3 * i + k] = view.rotation[3 * i + k] / static_cast<double>(radius);
            translation[i] -= linear[3 * i + k] * center[k];
        }
        eye[i] = center[i] - static_cast<double>(radius) * view.rotation[6 + i] * config.distance;
    }
    ModelView<float> mv;
    for (int k = 0; k < 9; ++k) mv.linear[k] = static_cast<float>(linear[k]);
    set_eye(linear, translation, eye, mv);
    return mv;
}

// Returns the transform from the group's coordinates to a view.
V3DG_HD V3DG_INLINE ModelView<float> view_of_group(const FitConfig& config, const FitView& view) {
    const float center[3] = {0, 0, 0};
    return view_of_world(config, center, 1, view);
}

V3DG_HD V3DG_INLINE Pinhole<float> camera_of(const FitView& view, float scale) {
    const float size = scale * static_cast<float>(view.size);
    return {.fx = scale * view.focal,
            .fy = scale * view.focal,
            .cx = scale * view.cx,
            .cy = scale * view.cy,
            .width = size,
            .height = size,
            .near_depth = 1e-3f};
}

constexpr float kLeastScale = 1e-5f;  // relative to the radius; much smaller than a
                                      // pixel
// Distance of an opacity from 0 and 1. It keeps the logit finite, and its gradient
// above 0.
constexpr float kLeastOpacity = 1e-4f;
constexpr float kLog2e = 1.4426950408889634f;

V3DG_HD V3DG_INLINE float log_of_scale(float scale) { return ::logf(max_of(scale, kLeastScale)); }
V3DG_HD V3DG_INLINE float logit_of_opacity(float opacity) {
    const float o = min_of(max_of(opacity, kLeastOpacity), 1 - kLeastOpacity);
    return ::logf(o / (1 - o));
}

// Clamps a coordinate of a mean to the box around the ball. A mean outside all pictures
// would have no gradient, so it would never return.
template <class V>
V3DG_HD V3DG_INLINE V held_in_box(V x) {
    return min_of(all_lanes<V>(1.0f), max_of(all_lanes<V>(-1.0f), x));
}

// Converts a log scale to a scale between a tiny positive value and 1, the ball's
// radius. Gaussians of the target are never larger than the ball. A fit could not
// correct extreme values.
template <class V>
V3DG_HD V3DG_INLINE V scale_of_log(V x) {
    return exp2_in_range(min_of(all_lanes<V>(0.0f), max_of(all_lanes<V>(-20.0f), x * kLog2e)));
}
// Converts a logit to an opacity. The opacity stays kLeastOpacity away from 0 and 1,
// where gradients vanish. The upper limit loses nothing, because alpha is clamped to
// 0.999 anyway.
template <class V>
V3DG_HD V3DG_INLINE V opacity_of_logit(V x) {
    constexpr float kMost = 13.287568f;  // log2(1 / kLeastOpacity - 1)
    return 1 / (1 + exp2_in_range(
                        min_of(all_lanes<V>(kMost), max_of(all_lanes<V>(-kMost), x * -kLog2e))));
}

// The step sizes of one step of Adam.
struct FitStep {
    // the step of positions is in the units of FitConfig
    float position, quat, log_scale, logit, sh0, sh_rest;
    float correction1, correction2;
};

V3DG_HD inline FitStep fit_step(const FitConfig& config, int index) {
    const double progress = config.steps > 1 ? static_cast<double>(index) / (config.steps - 1) : 0;
    const float decay = static_cast<float>(::pow(static_cast<double>(config.final_step), progress));
    return {.position = decay * config.step_position,
            .quat = decay * config.step_quat,
            .log_scale = decay * config.step_log_scale,
            .logit = decay * config.step_logit,
            .sh0 = decay * config.step_sh0,
            .sh_rest = decay * config.step_sh_rest,
            .correction1 = static_cast<float>(1 / (1 - ::pow(kAdamBeta1, index + 1.0))),
            .correction2 = static_cast<float>(
                1 / (1 - ::pow(static_cast<double>(config.beta2), index + 1.0)))};
}

V3DG_HD inline float position_step(const FitConfig& config, const FitGroup& group,
                                   const FitStep& step) {
    return config.position_in_world ? step.position / group.radius : step.position;
}

// For mean differences below this value, the loss of a cell is quadratic. Otherwise
// rounding would decide the sign of the gradient.
constexpr float kLeastMean = 1e-4f;

// Returns the gradient of a cell's loss with respect to each of its 4 x 4 pixels. `sum`
// is the sum of the pixels' differences. `weight` is the gradient of the absolute
// difference of one pixel.
V3DG_HD V3DG_INLINE float cell_slope(const LossWeights& loss, float sum, float weight) {
    const float relative = sum / (16 * kLeastMean);
    // The order of min_of() and max_of() gives a finite result for NaN, too.
    return loss.cells * weight * max_of(min_of(relative, 1.0f), -1.0f);
}

// Returns the loss by which the initial values and the result are compared. `error` has
// the mean absolute differences of colour and of alpha.
V3DG_HD inline double residual_loss(const LossWeights& loss, const double error[2]) {
    return loss.l1 * error[0] + loss.alpha * error[1];
}

}  // namespace v3dg
