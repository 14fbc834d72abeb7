#include "residency/host_pages.h"

#include "base/parallel_for.h"

namespace v3dg {

HostPages::HostPages(const PagePool& pool) {
    if (pool.keeps_codes())
        make_codes(pool);
    else
        make_planes(pool);
}

void HostPages::make_planes(const PagePool& pool) {
    stride_ = pool.plan().num_rows() + kPlanePadding;
    const size_t num_sh = 3 * num_sh_bases(pool.max_sh_degree());
    const float* plane = storage_.reserve((11 + num_sh) * stride_);
    GaussianPlanes<float> planes{};
    const auto add = [&](size_t width, const float** pointers) {
        for (size_t k = 0; k < width; ++k, plane += stride_) pointers[k] = plane;
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

void HostPages::make_codes(const PagePool& pool) {
    const SlotPlan& plan = pool.plan();
    const int sh_degree = pool.max_sh_degree();
    offset_ = plan.empty_offsets();
    slots_ = {.records = records_.reserve(kRecordWords * plan.num_rows()),
              .sh = sh_.reserve(num_sh_words(sh_degree) * plan.num_rows()),
              .ranges = ranges_.reserve(range_bytes(sh_degree) * plan.num_clusters()),
              .offset = offset_.data(),
              .range_size = range_bytes(sh_degree),
              .sh_stride = static_cast<uint32_t>(sh_degree),
              .num_clusters = plan.num_clusters()};
    for (uint32_t b = 0; b < pool.num_bundles(); ++b)
        codes_.push_back(slots_.codes(pool.source(b).sh_degree()));
}

void HostPages::write_rows(const PageSource& source, const PageChange& change) {
    std::vector<float> decoded;
    const GaussianRows<const float> rows = source.rows(change.page, change.bytes, decoded);
    float* plane = storage_.data() + change.row;
    const auto fill = [&](const float* values, size_t width) {
        for (size_t a = 0; a < width; ++a, plane += stride_)
            for (size_t i = 0; i < rows.size; ++i) plane[i] = values[i * width + a];
    };
    fill(rows.means, 3);
    fill(rows.quats, 4);
    fill(rows.scales, 3);
    fill(rows.opacities, 1);
    fill(rows.sh, rows.num_sh());
}

void HostPages::apply(const PagePool& pool, const std::vector<PageChange>& changes) {
    parallel_for(changes.size(), 4, [&](size_t k) {
        const PageChange& change = changes[k];
        if (change.bytes == nullptr) return;
        if (pool.keeps_codes())
            cpu::write_slot(pool.slot_page(change), slots_);
        else
            write_rows(pool.source(change.bundle), change);
    });
}

}  // namespace v3dg
