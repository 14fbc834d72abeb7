// Fits a group on a single CPU thread. In the group's coordinates, the ball is at the
// origin and has radius 1. Therefore a step size means the same for every group, and
// groups far from the world's origin lose no precision.

#include "fit_group/fit_group.h"

#include <cmath>

#include "fit_group/comparison.h"
#include "fit_group/fit_group_math.h"
#include "fit_group/group_picture.h"
#include "fit_group/student.h"

namespace v3dg {
namespace V3DG_ISA {

void fit_target(const FitConfig& config, const FitGroup& group, const FitTarget& target,
                const FitView& view, FitScratch& scratch, FitImage& image) {
    const int ss = config.supersample;
    const Draw<float> draw{.model = target.model,
                           .first = group.target_first,
                           .count = group.target_count,
                           .view = view_of_world(config, group.center, group.radius, view),
                           .appearance = {target.filter_px2, target.antialiased, false}};
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
