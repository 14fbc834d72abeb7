#pragma once

// Formulas of refine_cuts() and weigh_cuts(), shared by the CPU and CUDA.

#include <cfloat>
#include <vector>

#include "camera/camera.h"
#include "fit_group/fit_group_math.h"
#include "levels/refine_cuts.h"
#include "math/quat.h"

namespace v3dg {

// Returns the number of pixels of a camera's picture.
inline size_t num_pixels(const Camera& camera) {
    return static_cast<size_t>(camera.width) * static_cast<size_t>(camera.height);
}

// Returns value k of a pixel, averaged over `samples` x `samples` pixels of a larger
// picture. `width` is the width of the smaller picture.
V3DG_HD inline float box_average(const float* plane, size_t width, size_t num_values, size_t k,
                                 size_t x, size_t y, int samples) {
    const auto side = static_cast<size_t>(samples);
    float sum = 0;
    for (size_t row = y * side; row < (y + 1) * side; ++row)
        for (size_t column = x * side; column < (x + 1) * side; ++column)
            sum += plane[(row * width * side + column) * num_values + k];
    return sum / static_cast<float>(samples * samples);
}

// The values of one pixel: premultiplied colour, and alpha.
struct PixelValues {
    float value[4];
};

// The planes of a picture: colour with three channels, and alpha.
struct ReadPlanes {
    const float *color, *alpha;

    V3DG_HD PixelValues at(size_t pixel) const {
        return {{color[3 * pixel], color[3 * pixel + 1], color[3 * pixel + 2], alpha[pixel]}};
    }
};

// Size, px, of the cells whose mean differences are part of the loss.
constexpr size_t kCellSide = 4;

// Returns the number of cells along a side.
V3DG_HD inline size_t num_cells(size_t side) { return (side + kCellSide - 1) / kCellSide; }

// Returns the number of pixels in all cells of a camera's picture. It includes pixels
// of cells beyond the picture's border.
inline size_t num_pixels_of_cells(const Camera& camera) {
    return num_cells(static_cast<size_t>(camera.width)) *
           num_cells(static_cast<size_t>(camera.height)) * kCellSide * kCellSide;
}

// Replaces the differences between two pictures at a pixel by the gradients of the
// loss, for a picture of weight 1. `sum` has the summed differences of the pixel's
// cell. Returns the pixel's loss, without the loss of the cell.
V3DG_HD inline float put_slopes(const LossWeights& loss, const PixelValues& sum,
                                PixelValues& pixel) {
    float pixel_loss = 0;
    for (int k = 0; k < 4; ++k) {
        const float weight = k < 3 ? loss.l1 / 3 : loss.alpha;
        pixel_loss += weight * ::fabsf(pixel.value[k]);
        pixel.value[k] = l1_vjp(pixel.value[k], weight);
        if (loss.cells > 0) pixel.value[k] += cell_slope(loss, sum.value[k], weight);
    }
    return pixel_loss;
}

// Sums over the pixels of a window.
struct WindowSums {
    static constexpr int kValues = 9;
    double values[kValues];

    // The loss, without the losses of cells and of the whole window.
    V3DG_HD double& loss() { return values[0]; }
    V3DG_HD double loss() const { return values[0]; }
    // Sum of picture minus target, and sum of the target. The channels are
    // premultiplied colour and alpha.
    V3DG_HD double& difference(int k) { return values[1 + k]; }
    V3DG_HD double difference(int k) const { return values[1 + k]; }
    V3DG_HD double& target(int k) { return values[5 + k]; }
    V3DG_HD double target(int k) const { return values[5 + k]; }

    V3DG_HD void add_pixel(const PixelValues& pixel, const PixelValues& wanted) {
        for (int k = 0; k < 4; ++k) {
            difference(k) +=
                static_cast<double>(pixel.value[k]) - static_cast<double>(wanted.value[k]);
            target(k) += static_cast<double>(wanted.value[k]);
        }
    }
    V3DG_HD void add(const WindowSums& other) {
        for (int i = 0; i < kValues; ++i) values[i] += other.values[i];
    }
};

// The part of the gradient that all pixels of a window have in common.
struct WindowSlopes {
    float weight;       // weight of the picture
    float of_means[4];  // gradient of the loss of the window's sums, before weighting

    V3DG_HD float weighed(float slope, int k) const { return weight * (slope + of_means[k]); }
};

// Parameters of the loss of a window's sums. This loss is needed because absolute
// differences of pixels and cells are smallest at medians. Medians are darker than
// means, and have less alpha where gaussians are faint. The loss is linear in the
// difference of the sums. It is quadratic where that difference is smaller than
// kSmallMeans of the target's sum, so that windows whose sums are right are hardly
// disturbed. A colour counts as at least kLeastColor of alpha, because a relative error
// of black is not visible.
constexpr double kSmallMeans = 0.02, kLeastColor = 0.1;
constexpr double kLeastSum = 1e-30;  // keeps the quotient finite if the target is empty
V3DG_HD inline void put_slopes_of_means(const LossWeights& loss, float means,
                                        const WindowSums& sums, float of_means[4]) {
    for (int k = 0; k < 4; ++k) {
        const float weight = k < 3 ? loss.l1 / 3 : loss.alpha;
        const double target = max_of(sums.target(k), kLeastColor * sums.target(3));
        const auto relative =
            static_cast<float>(sums.difference(k) / max_of(kSmallMeans * target, kLeastSum));
        // The order of min_of() and max_of() gives a finite result for NaN, too.
        of_means[k] = means * weight * max_of(min_of(relative, 1.0f), -1.0f);
    }
}

// Returns the weight of a picture, one over its loss, so that the sum over pictures
// measures relative losses. Otherwise, fitting small pictures, in which coarse levels
// have larger absolute errors, would make large pictures worse. If the loss per pixel
// is below kLeastLoss, the picture is accurate enough, so its weight hardly grows
// further.
constexpr double kLeastLoss = 1e-4;
V3DG_HD inline float weight_of_picture(double loss_sum, double num_pixels) {
    return static_cast<float>(1 / (loss_sum + kLeastLoss * num_pixels));
}

// Returns the part of the gradient that all pixels of a window have in common.
V3DG_HD inline WindowSlopes slopes_of_window(const LossWeights& loss, float means,
                                             const WindowSums& sums, double num_pixels) {
    WindowSlopes slopes;
    slopes.weight = weight_of_picture(sums.loss(), num_pixels);
    put_slopes_of_means(loss, means, sums, slopes.of_means);
    return slopes;
}

// Sets the gradient of a pixel for a loss that is the sum of the first channel.
V3DG_HD inline void put_sum_slopes(float color[3], float& alpha) {
    for (int k = 0; k < 3; ++k) color[k] = k == 0 ? 1.0f : 0.0f;
    alpha = 0;
}

// Returns the step sizes for a gaussian that `num_windows` of the step's windows show.
// The relative noise of a sum of n gradients falls with sqrt(n), so step sizes may grow
// with sqrt(n).
V3DG_HD inline FitStep step_of_windows(FitStep step, int num_windows) {
    const float factor = ::sqrtf(static_cast<float>(num_windows));
    for (float* size :
         {&step.position, &step.quat, &step.log_scale, &step.logit, &step.sh0, &step.sh_rest})
        *size *= factor;
    return step;
}

// The moments of Adam. Value k of gaussian i is at index k * n + i, where n is the
// number of gaussians.
struct Moments {
    float *m, *v;
};

// Adds the gradient in row `from` of `source` to row `to` of `sum`.
V3DG_HD inline void add_gradient(const GaussianRows<const float>& source, size_t from,
                                 const GaussianRows<float>& sum, size_t to) {
    for (size_t k = 0; k < 3; ++k) sum.means[3 * to + k] += source.means[3 * from + k];
    for (size_t k = 0; k < 4; ++k) sum.quats[4 * to + k] += source.quats[4 * from + k];
    for (size_t k = 0; k < 3; ++k) sum.scales[3 * to + k] += source.scales[3 * from + k];
    sum.opacities[to] += source.opacities[from];
    const auto num_sh = static_cast<size_t>(source.num_sh());
    for (size_t k = 0; k < num_sh; ++k) sum.sh[num_sh * to + k] += source.sh[num_sh * from + k];
}

// Performs one step of Adam for gaussian i. Its gradient is in row g of `gradient`.
// Steps of positions are relative to `radius`. Scales are updated as logarithms and
// opacities as logits, within the ranges of a fit.
V3DG_HD inline void move_gaussian(const GaussianRows<float>& rows, size_t i,
                                  const GaussianRows<const float>& gradient, size_t g, float radius,
                                  const FitStep& step, float beta2, const Moments& moments) {
    size_t moment = i;
    const auto moved = [&](float value, float slope, float size) {
        // A NaN or infinity would stay in the moments forever.
        if (!(::fabsf(slope) <= FLT_MAX)) slope = 0;
        const float next = adam_step(value, slope, moments.m[moment], moments.v[moment], size,
                                     beta2, step.correction1, step.correction2);
        moment += rows.size;
        return next;
    };
    for (int k = 0; k < 3; ++k)
        rows.means[3 * i + k] =
            moved(rows.means[3 * i + k], gradient.means[3 * g + k], step.position * radius);
    float quat[4];
    for (int k = 0; k < 4; ++k)
        quat[k] = moved(rows.quats[4 * i + k], gradient.quats[4 * g + k], step.quat);
    normalise_quat(quat);
    for (int k = 0; k < 4; ++k) rows.quats[4 * i + k] = quat[k];
    for (int k = 0; k < 3; ++k) {
        const float scale = rows.scales[3 * i + k], slope = gradient.scales[3 * g + k] * scale;
        rows.scales[3 * i + k] =
            radius * scale_of_log(moved(log_of_scale(scale / radius), slope, step.log_scale));
    }
    const float opacity = rows.opacities[i],
                slope = gradient.opacities[g] * opacity * (1 - opacity);
    rows.opacities[i] = opacity_of_logit(moved(logit_of_opacity(opacity), slope, step.logit));
    const size_t num_sh = static_cast<size_t>(rows.num_sh());
    for (size_t k = 0; k < num_sh; ++k) {
        float& value = rows.sh[i * num_sh + k];
        value = moved(value, gradient.sh[g * num_sh + k], k < 3 ? step.sh0 : step.sh_rest);
    }
}

// Copies row `from` of `source` to row `to`.
V3DG_HD inline void copy_gaussian(const GaussianRows<const float>& source, size_t from,
                                  const GaussianRows<float>& rows, size_t to) {
    copy_shape(source, from, rows, to);
    const auto num_sh = static_cast<size_t>(source.num_sh());
    for (size_t k = 0; k < num_sh; ++k) rows.sh[num_sh * to + k] = source.sh[num_sh * from + k];
}

// Copies a gaussian with a grey colour and SH degree 0. The gradient with respect to
// this colour measures how much of the gaussian is visible.
V3DG_HD inline void copy_in_grey(const GaussianRows<const float>& source, size_t from,
                                 const GaussianRows<float>& rows, size_t to) {
    copy_shape(source, from, rows, to);
    for (size_t k = 0; k < 3; ++k) rows.sh[3 * to + k] = 0;
}

// Returns the fraction of a picture that a gaussian covers. `gradient` is the gradient
// of the picture's sum with respect to the colour of a gaussian that copy_in_grey()
// wrote.
V3DG_HD inline double blend_weight(float gradient, size_t num_pixels) {
    return static_cast<double>(gradient) / (kShBase0 * static_cast<double>(num_pixels));
}

// Returns the number of values per gaussian.
V3DG_HD inline size_t num_values(int sh_degree) {
    return 11 + 3 * static_cast<size_t>(num_sh_bases(sh_degree));
}

// Divides a block of memory into rows for `count` gaussians, with num_values() floats
// per gaussian. Values with an alignment of 16 bytes come first.
V3DG_HD inline GaussianRows<float> rows_in(float* memory, size_t count, int sh_degree) {
    const size_t num_sh = 3 * static_cast<size_t>(num_sh_bases(sh_degree));
    float* rest = memory + (4 + num_sh) * count;
    return {.means = rest,
            .quats = memory,
            .scales = rest + 3 * count,
            .opacities = rest + 6 * count,
            .sh = memory + 4 * count,
            .size = count,
            .sh_degree = sh_degree};
}

// Returns the indices of the gaussians of clusters.
inline std::vector<uint32_t> gaussians_of(const ClusterTable& table,
                                          const std::vector<int32_t>& clusters) {
    std::vector<uint32_t> gaussians;
    for (const int32_t c : clusters)
        for (int64_t i = table.offset[c]; i < table.offset[c + 1]; ++i)
            gaussians.push_back(static_cast<uint32_t>(i));
    return gaussians;
}

}  // namespace v3dg
