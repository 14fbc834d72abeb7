#pragma once

// Computes the loss of a group's pictures on the CPU, and its gradient.

#include <algorithm>
#include <vector>

#include "fit_group/group_picture.h"
#include "fit_group/student.h"

namespace v3dg {
namespace V3DG_ISA {

// Draws the student (the gaussians that are fitted), compares the picture with its
// target, and accumulates gradients.
class Comparison {
  public:
    Comparison(const FitConfig& config) : config_(config) {}

    // Adds the mean absolute differences of colour and of alpha in one view to `error`.
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

    // Computes the L1 parts of the loss in one tile, and adds the part of each pixel to
    // `error`. If `grad` is not null, also computes the gradients of the tile's pixels.
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
            if (inside && grad != nullptr && config_.loss.cells > 0)
                add_cell_slopes(block, tile, planes, d_color, d_alpha, *grad);
        }
        error[0] += sum_of(color_sum) / (3 * num_pixels);
        error[1] += sum_of(alpha_sum) / num_pixels;
    }

    // Adds the gradient of a block's mean differences. A block is a cell of the loss.
    void add_cell_slopes(int block, const TilePlanes<float>& tile, const float* planes,
                         float d_color, float d_alpha, TileGradient<float>& grad) {
        using V = Vec<float>;
        const int first = block * kBlockPixels, last = first + kBlockPixels;
        for (int c = 0; c < 3; ++c) {
            V sum = V{};
            for (int p = first; p < last; p += kLanes<float>)
                sum += load(tile.color[c] + p) - load(planes + c * kTilePixels + p);
            const float slope = cell_slope(config_.loss, sum_of(sum), d_color);
            for (int p = first; p < last; p += kLanes<float>)
                store(grad.d_color[c] + p, load(grad.d_color[c] + p) + slope);
        }
        V sum = V{};
        for (int p = first; p < last; p += kLanes<float>) {
            const V transmittance = load(tile.transmittance + p);
            const V covered = 1 - (transmittance < V{} ? -transmittance : transmittance);
            sum += covered - load(planes + 3 * kTilePixels + p);
        }
        const float slope = cell_slope(config_.loss, sum_of(sum), d_alpha);
        for (int p = first; p < last; p += kLanes<float>)
            store(grad.d_weight + p, load(grad.d_weight + p) + slope);
    }

    // Adds the gradient of the D-SSIM part of the loss.
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

}  // namespace V3DG_ISA
}  // namespace v3dg
