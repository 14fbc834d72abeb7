#include "fit_group/fit_group.h"

#include <algorithm>
#include <cmath>

#include "fit_group/fit_group_math.h"
#include "project/project.h"
#include "rasterize/rasterize.h"
#include "rasterize/simd_blend.h"
#include "tile_bin/tile_bin.h"

// One thread fits one group, start to end. The group's frame has its ball at the origin with radius
// 1, so step sizes mean the same for every group and nothing is lost far from the world's origin.

namespace v3dg {
namespace V3DG_ISA {

constexpr int kPlanes = 4;  // red, green, blue, alpha

static V3DG_INLINE Window square(int size) { return {0, 0, size, size}; }
static int tiles_across(const FitView& view) { return (view.size + kTileSize - 1) / kTileSize; }

// Projects a draw and sorts what is seen by depth; returns how many.
static size_t project_sorted(const Draw<float>& draw, const Pinhole<float>& camera,
                             FitScratch& scratch) {
    Record<float>* records = scratch.records.reserve(draw.count);
    uint32_t* source = scratch.source.reserve(draw.count);
    const Window all = square(static_cast<int>(camera.width));
    Reach unused;
    const size_t count =
        project<float>(draw, 0, draw.count, camera, all, records, source, 0, unused);
    uint64_t* order = scratch.order.reserve(count);
    scratch.format = EntryFormat::of(count, 0, INT32_MAX);
    for (size_t i = 0; i < count; ++i)
        order[i] = scratch.format.entry(depth_bits_of(records[i].depth), i, 0);
    sort_tile(records, scratch.format, order, count, scratch.order_scratch.reserve(count));
    return count;
}

static bool misses_tile(const Record<float>& g, int left, int top) {
    return g.x1 < left || g.y1 < top || g.x0 >= left + kTileSize || g.y0 >= top + kTileSize;
}

// Blends records in this order.
static void blend_sorted(const FitScratch& scratch, const uint64_t* order, size_t count, int left,
                         int top, int size, TilePlanes<float>& tile) {
    blend_tile<float, Extra::kNothing>(
        count, left, top, square(size), StopsBefore{}, tile, [&](size_t i) {
            const Record<float>& g = scratch.records.data()[scratch.format.record_of(order[i])];
            return Listed<float>{&g, misses_tile(g, left, top) ? 0 : blocks_of(g, left, top)};
        });
}

static int place_in_tile(int x, int y) {
    return (y / kBlockSize * kTileBlocks + x / kBlockSize) * kBlockPixels +
           y % kBlockSize * kBlockSize + x % kBlockSize;
}

void fit_target(const FitConfig& config, const FitGroup& group, const FitTarget& target,
                const FitView& view, FitScratch& scratch, FitImage& image) {
    const int ss = config.supersample;
    const Draw<float> draw{target.model,
                           group.target_first,
                           group.target_count,
                           view_of_world(config, group.center, group.radius, view),
                           {target.filter_px2, target.antialiased, false}};
    const size_t count = project_sorted(draw, camera_of(view, static_cast<float>(ss)), scratch);
    const int across = tiles_across(view);
    image.assign(static_cast<size_t>(across) * across * kPlanes * kTilePixels, 0.0f);
    const float share = 1.0f / static_cast<float>(ss * ss);
    TilePlanes<float> tile;
    uint64_t* const in_row = scratch.row.reserve(count);
    for (int top = 0; top < ss * view.size; top += kTileSize) {
        size_t num_in_row = 0;
        for (size_t i = 0; i < count; ++i) {
            const uint64_t entry = scratch.order.data()[i];
            const Record<float>& g = scratch.records.data()[scratch.format.record_of(entry)];
            if (g.y1 >= top && g.y0 < top + kTileSize) in_row[num_in_row++] = entry;
        }
        for (int left = 0; left < ss * view.size; left += kTileSize) {
            blend_sorted(scratch, in_row, num_in_row, left, top, ss * view.size, tile);
            for (int y = 0; y < kTileSize && top + y < ss * view.size; ++y) {
                const int py = (top + y) / ss;
                int px = left / ss, sample = left % ss;
                for (int x = 0; x < kTileSize && left + x < ss * view.size; ++x) {
                    const int p = place_in_tile(x, y),
                              out = place_in_tile(px % kTileSize, py % kTileSize);
                    float* planes = image.data() +
                                    static_cast<size_t>(py / kTileSize * across + px / kTileSize) *
                                        kPlanes * kTilePixels;
                    for (int c = 0; c < 3; ++c)
                        planes[c * kTilePixels + out] += share * tile.color[c][p];
                    planes[3 * kTilePixels + out] += share * (1 - std::fabs(tile.transmittance[p]));
                    if (++sample == ss) {
                        sample = 0;
                        ++px;
                    }
                }
            }
        }
    }
}

// The parameters of one group, one flat array in the order means, quats, log scales, logits, sh; a
// gradient and two moments of the same shape.
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
        return {&model_,
                0,
                n_,
                view_of_group(config_, view),
                {config_.filter_px2, config_.antialiased, false}};
    }

    void clear_gradient() { std::fill(gradient_.begin(), gradient_.end(), 0.0f); }

    // Adds the gradients of records to those of the parameters.
    void add_gradient(const Draw<float>& draw, const Pinhole<float>& camera, const uint32_t* source,
                      const RecordGradient<float>* d_records, size_t count) {
        by_value_.resize(gradient_.size());
        float* g = by_value_.data();
        const GaussianRows<float> out{g,           g + 3 * n_, g + 7 * n_,      g + 10 * n_,
                                      g + 11 * n_, n_,         model_.sh_degree};
        project_backward<float>(draw, source, d_records, count, camera, out);
        for (size_t i = 0; i < count; ++i) {
            const size_t at = source[i];
            for (int k = 0; k < 3; ++k) gradient_[3 * at + k] += out.means[3 * at + k];
            for (int k = 0; k < 4; ++k) gradient_[3 * n_ + 4 * at + k] += out.quats[4 * at + k];
            for (int k = 0; k < 3; ++k)
                gradient_[7 * n_ + 3 * at + k] += out.scales[3 * at + k] * model_.scale[k][at];
            const float o = model_.opacity[at];
            gradient_[10 * n_ + at] += out.opacities[at] * o * (1 - o);
            for (size_t k = 0; k < num_sh_; ++k)
                gradient_[11 * n_ + num_sh_ * at + k] += out.sh[num_sh_ * at + k];
        }
    }

    void step(int index) {
        const FitStep step = fit_step(config_, index);
        size_t at = 0;
        at = adam(at, 3 * n_, position_step(config_, group_, step), step);
        for (size_t i = 0; i < 3 * n_; ++i) value_[i] = held_in_box(value_[i]);
        at = adam(at, 4 * n_, step.quat, step);
        at = adam(at, 3 * n_, step.log_scale, step);
        at = adam(at, n_, step.logit, step);
        if (num_sh_ == 3) {
            adam(at, 3 * n_, step.sh0, step);
        } else {
            for (size_t i = 0; i < n_; ++i) {
                at = adam(at, 3, step.sh0, step);
                at = adam(at, num_sh_ - 3, step.sh_rest, step);
            }
        }
        activate();
    }

    // Writes the values back in world units; false, and nothing written, if one of them is not
    // finite.
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

    // Parameters to the planes that are drawn.
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

// Draws the student, compares it with its target, and adds to its gradient.
class Comparison {
  public:
    Comparison(const FitConfig& config) : config_(config) {}

    // Mean |difference| of colour and alpha of one view.
    void residual(const Student& student, const FitView& view, const FitImage& target,
                  double error[2]) {
        draw(student, view);
        const int across = tiles_across(view);
        for (int t = 0; t < across * across; ++t) compare(t, view, target, nullptr, error);
    }

    void add_gradient(Student& student, const FitView& view, const FitImage& target) {
        const size_t count = draw(student, view);
        const int across = tiles_across(view);
        d_records_.assign(count, RecordGradient<float>{});
        grad_.resize(tiles_.size());
        double unused[2] = {0, 0};
        for (int t = 0; t < across * across; ++t) compare(t, view, target, &grad_[t], unused);
        if (config_.loss.dssim > 0) add_dssim(view, target);
        const BlockPixels<float> pixels;
        for (int t = 0; t < across * across; ++t) {
            const int left = t % across * kTileSize, top = t / across * kTileSize;
            TilePlanes<float>& tile = tiles_[t];
            TileGradient<float>& grad = grad_[t];
            for (int p = 0; p < kTilePixels; p += kLanes<float>) {
                const Vec<float> t_now = load(tile.transmittance + p);
                const Vec<float> covered = 1 - (t_now < Vec<float>{} ? -t_now : t_now);
                Vec<float> total = load(grad.d_weight + p) * covered;
                for (int c = 0; c < 3; ++c)
                    total += load(grad.d_color[c] + p) * load(tile.color[c] + p);
                store(grad.total + p, total);
            }
            uint64_t alive = clear_tile(tile, left, top, square(view.size), Extra::kNothing);
            for (size_t i = 0; i < count && alive != 0; ++i) {
                const uint64_t r = scratch_.format.record_of(scratch_.order.data()[i]);
                const Record<float>& g = scratch_.records.data()[r];
                if (misses_tile(g, left, top)) continue;
                const uint64_t blocks = live_blocks(g, left, top, alive);
                RecordGradient<float> d;
                if (blocks == 0 || !blend_record_vjp<float, false>(g, blocks, left, top, pixels,
                                                                   grad, tile, alive, d))
                    continue;
                d_records_[r] += d;
            }
        }
        student.add_gradient(student.draw(view), camera_of(view, 1), scratch_.source.data(),
                             d_records_.data(), count);
    }

  private:
    size_t draw(const Student& student, const FitView& view) {
        const size_t count = project_sorted(student.draw(view), camera_of(view, 1), scratch_);
        const int across = tiles_across(view);
        tiles_.resize(static_cast<size_t>(across) * across);
        for (int t = 0; t < across * across; ++t)
            blend_sorted(scratch_, scratch_.order.data(), count, t % across * kTileSize,
                         t / across * kTileSize, view.size, tiles_[t]);
        return count;
    }

    // L1 parts of the loss in one tile: adds to the sums and, if wanted, writes the gradient of its
    // pixels.
    void compare(int t, const FitView& view, const FitImage& target, TileGradient<float>* grad,
                 double error[2]) {
        using V = Vec<float>;
        const int across = tiles_across(view);
        const int left = t % across * kTileSize, top = t / across * kTileSize;
        const float num_pixels = static_cast<float>(view.size) * static_cast<float>(view.size);
        const float d_color = config_.loss.l1 / (3 * num_pixels),
                    d_alpha = config_.loss.alpha / num_pixels;
        const float* planes = target.data() + static_cast<size_t>(t) * kPlanes * kTilePixels;
        const TilePlanes<float>& tile = tiles_[t];
        V color_sum = V{}, alpha_sum = V{};
        const auto magnitude = [](V x) { return x < V{} ? -x : x; };
        for (int block = 0; block < kTileBlocks * kTileBlocks; ++block) {
            const bool inside = left + block % kTileBlocks * kBlockSize < view.size &&
                                top + block / kTileBlocks * kBlockSize < view.size;
            for (int p = block * kBlockPixels; p < (block + 1) * kBlockPixels; p += kLanes<float>) {
                if (!inside) {
                    if (grad == nullptr) continue;
                    for (int c = 0; c < 3; ++c) store(grad->d_color[c] + p, V{});
                    store(grad->d_weight + p, V{});
                    continue;
                }
                for (int c = 0; c < 3; ++c) {
                    const V difference =
                        load(tile.color[c] + p) - load(planes + c * kTilePixels + p);
                    color_sum += magnitude(difference);
                    if (grad != nullptr) store(grad->d_color[c] + p, l1_vjp(difference, d_color));
                }
                const V transmittance = magnitude(load(tile.transmittance + p));
                const V difference = 1 - transmittance - load(planes + 3 * kTilePixels + p);
                alpha_sum += magnitude(difference);
                if (grad != nullptr) store(grad->d_weight + p, l1_vjp(difference, d_alpha));
            }
        }
        error[0] += sum_of(color_sum) / (3 * num_pixels);
        error[1] += sum_of(alpha_sum) / num_pixels;
    }

    // Adds the D-SSIM part to the gradient, in rows of pixels.
    void add_dssim(const FitView& view, const FitImage& target) {
        const int size = view.size, across = tiles_across(view);
        const size_t n = static_cast<size_t>(size) * size;
        rows_.resize(3 * n);
        for (int c = 0; c < 3; ++c) {
            for (int y = 0; y < size; ++y)
                for (int x = 0; x < size; ++x) {
                    const int t = y / kTileSize * across + x / kTileSize,
                              p = place_in_tile(x % kTileSize, y % kTileSize);
                    rows_[y * size + x] = tiles_[t].color[c][p];
                    rows_[n + y * size + x] =
                        target[(static_cast<size_t>(t) * kPlanes + c) * kTilePixels + p];
                }
            std::fill_n(rows_.begin() + 2 * n, n, 0.0f);
            dssim(rows_.data(), rows_.data() + n, size, size, config_.loss.dssim / 3,
                  rows_.data() + 2 * n, ssim_);
            for (int y = 0; y < size; ++y)
                for (int x = 0; x < size; ++x)
                    grad_[y / kTileSize * across + x / kTileSize]
                        .d_color[c][place_in_tile(x % kTileSize, y % kTileSize)] +=
                        rows_[2 * n + y * size + x];
        }
    }

    const FitConfig& config_;
    FitScratch scratch_;
    std::vector<TilePlanes<float>> tiles_;
    std::vector<TileGradient<float>> grad_;
    std::vector<RecordGradient<float>> d_records_;
    std::vector<float> rows_;
    SsimScratch ssim_;
};

void fit_group(const FitConfig& config, const FitGroup& group, const FitTarget& target,
               const FitImage* targets, const GaussianRows<float>& rows, float error[2],
               const std::atomic<bool>& cancel) {
    Student student(config, group, rows);
    Comparison comparison(config);
    FitScratch target_scratch;
    FitImage fresh;
    const uint64_t stride = visiting_stride(config);
    const auto measure = [&](const Student& s, double sum[2]) {
        sum[0] = sum[1] = 0;
        for (int i = 0; i < kHeldOutViews; ++i) {
            const uint64_t index = held_out_view(config, i);
            const FitView view = fit_view(config, group, index);
            if (config.num_views == 0)
                fit_target(config, group, target, view, target_scratch, fresh);
            comparison.residual(s, view, config.num_views > 0 ? targets[index] : fresh, sum);
        }
        sum[0] /= kHeldOutViews;
        sum[1] /= kHeldOutViews;
    };
    double start[2], end[2];
    measure(student, start);
    uint64_t next_view = 0;
    for (int s = 0; s < config.steps && !cancel.load(std::memory_order_relaxed); ++s) {
        student.clear_gradient();
        for (int b = 0; b < config.views_per_step; ++b, ++next_view) {
            const uint64_t index = visited_view(config, stride, next_view);
            const FitView view = fit_view(config, group, index);
            if (config.num_views == 0)
                fit_target(config, group, target, view, target_scratch, fresh);
            comparison.add_gradient(student, view, config.num_views > 0 ? targets[index] : fresh);
        }
        student.step(s);
    }
    measure(student, end);
    const bool better = config.steps > 0 &&
                        residual_loss(config.loss, end) <= residual_loss(config.loss, start) &&
                        student.write(rows);
    for (int k = 0; k < 2; ++k) error[k] = static_cast<float>(better ? end[k] : start[k]);
}

}  // namespace V3DG_ISA
}  // namespace v3dg
