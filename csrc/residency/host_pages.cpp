#include "residency/host_pages.h"

#include "base/parallel_for.h"

namespace v3dg {

HostPages::HostPages(const PagePool& pool, size_t num_rows) : stride_(num_rows + kPlanePadding) {
    const size_t num_sh = 3 * num_sh_bases(pool.max_sh_degree());
    const float* plane = storage_.reserve((11 + num_sh) * stride_);
    GaussianPlanes<float> planes{};
    const auto add = [&](size_t width, const float** of) {
        for (size_t k = 0; k < width; ++k, plane += stride_) of[k] = plane;
    };
    add(3, planes.mean);
    add(4, planes.quat);
    add(3, planes.scale);
    add(1, &planes.opacity);
    add(num_sh, planes.sh);
    for (uint32_t b = 0; b < pool.num_bundles(); ++b) {
        planes.sh_degree = pool.source(b).sh_degree();
        planes_.push_back(planes);
    }
}

void HostPages::apply(const PagePool& pool, const std::vector<PageChange>& changes) {
    parallel_for(changes.size(), 4, [&](size_t k) {
        const PageChange& change = changes[k];
        if (change.bytes == nullptr) return;
        std::vector<float> decoded;
        const GaussianRows<const float> rows =
            pool.source(change.bundle).rows(change.page, change.bytes, decoded);
        float* plane = storage_.data() + change.row;
        const auto fill = [&](const float* source, size_t width) {
            for (size_t a = 0; a < width; ++a, plane += stride_)
                for (size_t i = 0; i < rows.size; ++i) plane[i] = source[i * width + a];
        };
        fill(rows.means, 3);
        fill(rows.quats, 4);
        fill(rows.scales, 3);
        fill(rows.opacities, 1);
        fill(rows.sh, rows.num_sh());
    });
}

}  // namespace v3dg
