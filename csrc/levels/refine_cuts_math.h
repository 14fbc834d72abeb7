#pragma once

// Formulas of refine_cuts, for both of its halves.

#include <cfloat>
#include <vector>

#include "fit_group/fit_group_math.h"
#include "levels/refine_cuts.h"
#include "camera/camera.h"
#include "math/quat.h"

namespace v3dg {

// The same view with so many times the resolution.
V3DG_HD inline Camera enlarged(Camera camera, int factor) {
    for (double* px : {&camera.fx, &camera.fy, &camera.cx, &camera.cy, &camera.width,
                       &camera.height, &camera.x0, &camera.y0, &camera.x1, &camera.y1})
        *px *= factor;
    return camera;
}

// Colour or alpha of a pixel of the target, from `samples` a side: value k of each of `width`
// pixels.
V3DG_HD inline float box_average(const float* plane, size_t width, size_t num_values, size_t k,
                                 size_t x, size_t y, int samples) {
    const auto side = static_cast<size_t>(samples);
    float sum = 0;
    for (size_t row = y * side; row < (y + 1) * side; ++row)
        for (size_t column = x * side; column < (x + 1) * side; ++column)
            sum += plane[(row * width * side + column) * num_values + k];
    return sum / static_cast<float>(samples * samples);
}

// How far a pixel is off: the difference of its colour and alpha, weighed as in the loss.
V3DG_HD inline float loss_of_pixel(const LossWeights& loss, const float color[3], float alpha) {
    return loss.l1 / 3 * (::fabsf(color[0]) + ::fabsf(color[1]) + ::fabsf(color[2])) +
           loss.alpha * ::fabsf(alpha);
}

// A picture counts by how much of its loss is taken away, not by how large that is: else small
// pictures, which levels are farther off in, would be made better at the cost of large ones. Below
// this loss a picture is right, and counts by what is left.
constexpr double kLeastLoss = 1e-4;
V3DG_HD inline float weight_of_picture(double loss_sum, double num_pixels) {
    return static_cast<float>(1 / (loss_sum + kLeastLoss * num_pixels));
}

// What Adam keeps of value k of gaussian i of n, at k * n + i.
struct Moments {
    float *m, *v;
};

// A step of gaussian i, of which `gradient` has row g: position in parts of `radius`, scales by
// their logarithm and opacity by its logit, both in the range that a fit keeps them in.
V3DG_HD inline void move_gaussian(const GaussianRows<float>& rows, size_t i,
                                  const GaussianRows<const float>& gradient, size_t g, float radius,
                                  const FitStep& step, float beta2, const Moments& moments) {
    size_t at = i;
    const auto moved = [&](float value, float slope, float size) {
        if (!(::fabsf(slope) <= FLT_MAX)) slope = 0;  // would never be forgotten
        const float next = adam_step(value, slope, moments.m[at], moments.v[at], size, beta2,
                                     step.correction1, step.correction2);
        at += rows.size;
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

// Copies gaussian `from` to row `to`.
V3DG_HD inline void copy_gaussian(const GaussianRows<const float>& source, size_t from,
                                  const GaussianRows<float>& rows, size_t to) {
    copy_shape(source, from, rows, to);
    const auto num_sh = static_cast<size_t>(source.num_sh());
    for (size_t k = 0; k < num_sh; ++k) rows.sh[num_sh * to + k] = source.sh[num_sh * from + k];
}

// The same in grey, of SH degree 0: its gradient by that colour is what is seen of it, whatever its
// own is.
V3DG_HD inline void copy_in_grey(const GaussianRows<const float>& source, size_t from,
                                 const GaussianRows<float>& rows, size_t to) {
    copy_shape(source, from, rows, to);
    for (size_t k = 0; k < 3; ++k) rows.sh[3 * to + k] = 0;
}

// The part of a picture of so many pixels that a gaussian fills, from the gradient of the picture's
// sum by the colour of a gaussian that copy_in_grey made.
V3DG_HD inline double blend_weight(float gradient, size_t num_pixels) {
    return static_cast<double>(gradient) / (kShBase0 * static_cast<double>(num_pixels));
}

// How many values a gaussian has.
V3DG_HD inline size_t num_values(int sh_degree) {
    return 11 + 3 * static_cast<size_t>(num_sh_bases(sh_degree));
}

// `count` rows in one piece of memory, num_values() for each gaussian; what has to lie at a
// multiple of 16 bytes comes first.
V3DG_HD inline GaussianRows<float> rows_in(float* memory, size_t count, int sh_degree) {
    const size_t num_sh = 3 * static_cast<size_t>(num_sh_bases(sh_degree));
    float* rest = memory + (4 + num_sh) * count;
    return {rest, memory, rest + 3 * count, rest + 6 * count, memory + 4 * count, count, sh_degree};
}

// The gaussians of a view's clusters.
inline std::vector<uint32_t> gaussians_of(const ClusterTable& table, const CutView& view) {
    std::vector<uint32_t> gaussians;
    for (const int32_t c : view.clusters)
        for (int64_t i = table.offset[c]; i < table.offset[c + 1]; ++i)
            gaussians.push_back(static_cast<uint32_t>(i));
    return gaussians;
}

}  // namespace v3dg
