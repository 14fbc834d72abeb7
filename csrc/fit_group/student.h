#pragma once

// The gaussians of a group while they are fitted on the CPU: parameters, gradients, and
// steps of Adam.

#include <algorithm>
#include <cmath>
#include <vector>

#include "fit_group/fit_group_math.h"
#include "project/project.h"

namespace v3dg {
namespace V3DG_ISA {

// The fitted gaussians of one group. A single array holds all parameters: means,
// quaternions, log scales, logits and SH coefficients, in this order. The gradient and
// the two moments have the same layout.
class Student {
  public:
    Student(const FitConfig& config, const FitGroup& group, const GaussianRows<float>& rows)
        : config_(config),
          group_(group),
          n_(group.count),
          num_sh_(3 * num_sh_bases(rows.sh_degree)) {
        const size_t size = n_ * (11 + num_sh_);
        const size_t padded = (size + kPlanePadding) / kPlanePadding * kPlanePadding;
        value_.assign(padded, 0);
        gradient_.assign(padded, 0);
        m_.assign(padded, 0);
        v_.assign(padded, 0);
        float* p = value_.data();
        const float inverse = 1 / group.radius;
        for (size_t i = 0; i < n_; ++i)
            for (int k = 0; k < 3; ++k)
                *p++ = (rows.means[3 * (group.first + i) + k] - group.center[k]) * inverse;
        p = std::copy_n(rows.quats + 4 * group.first, 4 * n_, p);
        for (size_t i = 0; i < 3 * n_; ++i)
            *p++ = log_of_scale(rows.scales[3 * group.first + i] * inverse);
        for (size_t i = 0; i < n_; ++i) *p++ = logit_of_opacity(rows.opacities[group.first + i]);
        std::copy_n(rows.sh + num_sh_ * group.first, num_sh_ * n_, p);
        plane_size_ = n_ + kPlanePadding;
        planes_.assign((11 + num_sh_) * plane_size_, 0);
        float* plane = planes_.data();
        const auto next = [&] {
            const float* here = plane;
            plane += plane_size_;
            return here;
        };
        for (auto& q : model_.mean) q = next();
        for (auto& q : model_.quat) q = next();
        for (auto& q : model_.scale) q = next();
        model_.opacity = next();
        for (size_t k = 0; k < num_sh_; ++k) model_.sh[k] = next();
        model_.sh_degree = rows.sh_degree;
        activate();
    }

    Draw<float> draw(const FitView& view) const {
        return {.model = &model_,
                .first = 0,
                .count = n_,
                .view = view_of_group(config_, view),
                .appearance = {config_.filter_px2, config_.antialiased, false}};
    }

    void clear_gradient() { std::fill(gradient_.begin(), gradient_.end(), 0.0f); }

    // Adds the gradients of records to the gradients of the parameters.
    void add_gradient(const Draw<float>& draw, const Pinhole<float>& camera, const uint32_t* source,
                      const RecordGradient<float>* d_records, size_t count) {
        by_value_.resize(gradient_.size());
        float* g = by_value_.data();
        const GaussianRows<float> out{.means = g,
                                      .quats = g + 3 * n_,
                                      .scales = g + 7 * n_,
                                      .opacities = g + 10 * n_,
                                      .sh = g + 11 * n_,
                                      .size = n_,
                                      .sh_degree = model_.sh_degree};
        project_backward<float>(draw, source, d_records, count, intrinsics_of(camera), out);
        for (size_t i = 0; i < count; ++i) {
            const size_t gaussian = source[i];
            for (int k = 0; k < 3; ++k) gradient_[3 * gaussian + k] += out.means[3 * gaussian + k];
            for (int k = 0; k < 4; ++k)
                gradient_[3 * n_ + 4 * gaussian + k] += out.quats[4 * gaussian + k];
            for (int k = 0; k < 3; ++k)
                gradient_[7 * n_ + 3 * gaussian + k] +=
                    out.scales[3 * gaussian + k] * model_.scale[k][gaussian];
            const float o = model_.opacity[gaussian];
            gradient_[10 * n_ + gaussian] += out.opacities[gaussian] * o * (1 - o);
            for (size_t k = 0; k < num_sh_; ++k)
                gradient_[11 * n_ + num_sh_ * gaussian + k] += out.sh[num_sh_ * gaussian + k];
        }
    }

    void step(int index) {
        const FitStep step = fit_step(config_, index);
        size_t next_value = 0;
        next_value = adam(next_value, 3 * n_, position_step(config_, group_, step), step);
        for (size_t i = 0; i < 3 * n_; ++i) value_[i] = held_in_box(value_[i]);
        next_value = adam(next_value, 4 * n_, step.quat, step);
        next_value = adam(next_value, 3 * n_, step.log_scale, step);
        next_value = adam(next_value, n_, step.logit, step);
        if (num_sh_ == 3) {
            adam(next_value, 3 * n_, step.sh0, step);
        } else {
            for (size_t i = 0; i < n_; ++i) {
                next_value = adam(next_value, 3, step.sh0, step);
                next_value = adam(next_value, num_sh_ - 3, step.sh_rest, step);
            }
        }
        activate();
    }

    // Writes the parameters to the rows, in world units. If any parameter is not
    // finite, writes nothing and returns false.
    bool write(const GaussianRows<float>& rows) const {
        for (size_t i = 0; i < n_ * (11 + num_sh_); ++i)
            if (!std::isfinite(value_[i])) return false;
        const size_t first = group_.first;
        for (size_t i = 0; i < n_; ++i) {
            for (int k = 0; k < 3; ++k) {
                rows.means[3 * (first + i) + k] = static_cast<float>(
                    group_.center[k] + static_cast<double>(group_.radius) * value_[3 * i + k]);
                rows.scales[3 * (first + i) + k] = group_.radius * model_.scale[k][i];
            }
            const float* q = &value_[3 * n_ + 4 * i];
            const float length = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
            for (int k = 0; k < 4; ++k)
                rows.quats[4 * (first + i) + k] = length > 0 ? q[k] / length : float(k == 0);
            rows.opacities[first + i] = model_.opacity[i];
        }
        std::copy_n(&value_[11 * n_], num_sh_ * n_, rows.sh + num_sh_ * first);
        return true;
    }

  private:
    size_t adam(size_t begin, size_t count, float step_size, const FitStep& step) {
        const float beta2 = config_.beta2;
        size_t i = begin;
        const size_t end = begin + count;
        for (; i + kLanes<float> <= end; i += kLanes<float>) {
            Vec<float> m = load(&m_[i]), v = load(&v_[i]);
            const Vec<float> next = adam_step(load(&value_[i]), load(&gradient_[i]), m, v,
                                              step_size, beta2, step.correction1, step.correction2);
            store(&m_[i], m);
            store(&v_[i], v);
            store(&value_[i], next);
        }
        for (; i < end; ++i)
            value_[i] = adam_step(value_[i], gradient_[i], m_[i], v_[i], step_size, beta2,
                                  step.correction1, step.correction2);
        return end;
    }

    // Converts the parameters to the planes that are drawn.
    void activate() {
        const float* p = value_.data();
        float* plane = planes_.data();
        const auto spread = [&](size_t width) {
            for (size_t k = 0; k < width; ++k, plane += plane_size_)
                for (size_t i = 0; i < n_; ++i) plane[i] = p[width * i + k];
            p += width * n_;
        };
        const auto map = [&](float* at, auto f) {
            for (size_t i = 0; i < n_; i += kLanes<float>) store(at + i, f(load(at + i)));
        };
        spread(3);
        spread(4);
        float* scales = plane;
        spread(3);
        for (int k = 0; k < 3; ++k)
            map(scales + k * plane_size_, [](Vec<float> x) { return scale_of_log(x); });
        float* opacities = plane;
        spread(1);
        map(opacities, [](Vec<float> x) { return opacity_of_logit(x); });
        spread(num_sh_);
    }

    const FitConfig& config_;
    const FitGroup& group_;
    size_t n_, num_sh_, plane_size_ = 0;
    std::vector<float> value_, gradient_, by_value_, m_, v_, planes_;
    GaussianPlanes<float> model_{};
};

}  // namespace V3DG_ISA
}  // namespace v3dg
