// Distributes the groups of a level over threads. fit_group_cpu.cpp in fit_group/ fits
// a single group.

#include "levels/fit_level.h"

#include <algorithm>

#include "base/isa.h"
#include "base/parallel_for.h"
#include "fit_group/fit_group_math.h"
#include "frame/image.h"

namespace v3dg {

// Maximum size, in bytes, of the target pictures in memory.
constexpr size_t kTargetBytes = size_t(256) << 20;

void fit_level(const FitConfig& config, Span<const FitGroup> groups, const FitTarget& target,
               const GaussianRows<float>& rows, float* error, FitProgress& progress) {
    // Number of target pictures per group.
    const size_t num_pictures = config.num_views > 0 ? config.num_views + kHeldOutViews : 0;
    std::vector<FitImage> images;
    // Draw the target pictures first, in parallel over groups and views. So all threads
    // are busy, even in the last levels, which have only one or two groups.
    for (size_t first = 0; first < groups.size && !progress.cancel;) {
        size_t last = groups.size;
        if (num_pictures > 0) {
            const int size = fit_view(config, groups[first], 0).size;
            const size_t tiles = static_cast<size_t>((size + kTileSize - 1) / kTileSize);
            const size_t bytes =
                num_pictures * tiles * tiles * kTileSize * kTileSize * 4 * sizeof(float);
            last = std::min(groups.size,
                            first + std::max<size_t>(most_threads(), kTargetBytes / bytes));
            images.resize((last - first) * num_pictures);
            std::vector<FitScratch> scratch(most_threads());
            parallel_for(images.size(), 1, [&](size_t i) {
                if (progress.cancel) return;
                const FitGroup& group = groups[first + i / num_pictures];
                V3DG_DISPATCH_ISA(fit_target, config, group, target,
                                  fit_view(config, group, i % num_pictures),
                                  scratch[thread_index()], images[i]);
            });
        }
        parallel_for(last - first, 1, [&](size_t i) {
            if (progress.cancel) return;
            const size_t g = first + i;
            V3DG_DISPATCH_ISA(fit_group, config, groups[g], target,
                              images.data() + i * num_pictures, rows, error + 2 * g,
                              progress.cancel);
            double sum = progress.loss_sum.load();
            const double own_error[2] = {error[2 * g], error[2 * g + 1]};
            const double loss = residual_loss(config.loss, own_error);
            while (!progress.loss_sum.compare_exchange_weak(sum, sum + loss)) {
            }
            ++progress.groups_done;
        });
        first = last;
    }
}

}  // namespace v3dg
