#pragma once

// The parameters of a group on CUDA, and their updates. Means, quaternions, log scales
// and logits are stored in one plane per component. The SH coefficients follow,
// gaussian by gaussian.

#include <cfloat>

#include "fit_group/fit_group_math.h"
#include "fit_group/team.cuh"
#include "math/quat.h"

namespace v3dg {
namespace cuda {

template <class Fit>
__device__ Gaussian3d<float> gaussian_of(const Fit& fit, uint32_t i) {
    const float* value = fit.at(fit.layout.value);
    Gaussian3d<float> g;
    for (int k = 0; k < 3; ++k) g.mean[k] = value[k * fit.n + i];
    for (int k = 0; k < 4; ++k) g.quat[k] = value[(3 + k) * fit.n + i];
    for (int k = 0; k < 3; ++k) g.scale[k] = scale_of_log(value[(7 + k) * fit.n + i]);
    g.opacity = opacity_of_logit(value[10 * fit.n + i]);
    return g;
}

template <class Fit>
__device__ void start_parameters(const Fit& fit) {
    float* value = fit.at(fit.layout.value);
    float *m = fit.at(fit.layout.m), *v = fit.at(fit.layout.v);
    const float inverse = 1 / fit.job.group.radius;
    const GaussianRows<float>& rows = fit.in.rows;
    for (uint32_t i = fit.first(); i < fit.n; i += fit.stride()) {
        const size_t from = fit.job.group.first + i;
        for (int k = 0; k < 3; ++k) {
            value[k * fit.n + i] = (rows.means[3 * from + k] - fit.job.group.center[k]) * inverse;
            value[(7 + k) * fit.n + i] = log_of_scale(rows.scales[3 * from + k] * inverse);
        }
        for (int k = 0; k < 4; ++k) value[(3 + k) * fit.n + i] = rows.quats[4 * from + k];
        value[10 * fit.n + i] = logit_of_opacity(rows.opacities[from]);
    }
    for (uint32_t k = fit.first(); k < fit.num_sh * fit.n; k += fit.stride())
        value[11 * fit.n + k] = rows.sh[fit.num_sh * fit.job.group.first + k];
    for (uint32_t k = fit.first(); k < fit.num_values; k += fit.stride()) m[k] = v[k] = 0;
}

// Writes the parameters to the rows, in world units. If any parameter is not finite,
// writes nothing and returns false.
template <class Fit>
__device__ bool write_parameters(const Fit& fit) {
    const float* value = fit.at(fit.layout.value);
    bool finite = true;
    for (uint32_t k = threadIdx.x; k < fit.num_values; k += Fit::kThreads)
        finite = finite && fabsf(value[k]) <= FLT_MAX;
    if (!__syncthreads_and(finite)) return false;
    const GaussianRows<float>& rows = fit.in.rows;
    const FitGroup& group = fit.job.group;
    for (uint32_t i = fit.first(); i < fit.n; i += fit.stride()) {
        Gaussian3d<float> g = gaussian_of(fit, i);
        const size_t to = group.first + i;
        normalise_quat(g.quat);
        for (int k = 0; k < 3; ++k) {
            rows.means[3 * to + k] =
                static_cast<float>(group.center[k] + static_cast<double>(group.radius) * g.mean[k]);
            rows.scales[3 * to + k] = group.radius * g.scale[k];
        }
        for (int k = 0; k < 4; ++k) rows.quats[4 * to + k] = g.quat[k];
        rows.opacities[to] = g.opacity;
    }
    for (uint32_t k = fit.first(); k < fit.num_sh * fit.n; k += fit.stride())
        rows.sh[fit.num_sh * group.first + k] = value[11 * fit.n + k];
    return true;
}

// Adds the gradients of a batch of views to the gradients of the step. After the last
// batch, performs the step of Adam.
template <class Fit>
__device__ void move_parameters(const Fit& fit, const FitStep& step, int num_views, int turn,
                                bool is_first, bool is_last) {
    float *value = fit.at(fit.layout.value), *m = fit.at(fit.layout.m), *v = fit.at(fit.layout.v),
          *sum = fit.at(fit.layout.sum);
    const float position = position_step(fit.in.config, fit.job.group, step);
    const float beta2 = fit.in.config.beta2;
#pragma unroll 2
    for (uint32_t k = fit.first(); k < fit.num_values; k += fit.stride()) {
        float sum_of_views = is_first ? 0 : sum[k];
        for (int b = 0; b < num_views; ++b) sum_of_views += fit.gradient(turn, b)[k];
        if (!is_last) {
            sum[k] = sum_of_views;
            continue;
        }
        float size = step.sh0;
        if (k < 3 * fit.n)
            size = position;
        else if (k < 7 * fit.n)
            size = step.quat;
        else if (k < 10 * fit.n)
            size = step.log_scale;
        else if (k < 11 * fit.n)
            size = step.logit;
        else if (fit.num_sh > 3 && (k - 11 * fit.n) % fit.num_sh >= 3)
            size = step.sh_rest;
        const float moved = adam_step(value[k], sum_of_views, m[k], v[k], size, beta2,
                                      step.correction1, step.correction2);
        value[k] = k < 3 * fit.n ? held_in_box(moved) : moved;
    }
}

}  // namespace cuda
}  // namespace v3dg
