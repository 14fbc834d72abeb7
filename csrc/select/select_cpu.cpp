// A chunk of instances to a thread. Metrics are evaluated once a group; a cluster then reads two bytes.

#include "select/select.h"

#include <algorithm>

#include "base/parallel_for.h"

namespace v3dg {

namespace {

constexpr size_t kChunk = 16;

// Appends what instance i draws. fits_group: scratch for as many groups as any bundle has.
void select_instance(const SelectInput& in, size_t i, std::vector<uint8_t>& fits_group, SelectOutput& out) {
    const ClusterTable& table = in.bundles[in.instances.bundle[i]];
    const InstanceView view = view_from_instance(in.camera, in.instances.pose(i), table.pad_px);
    if (in.rule.culls && is_outside(table.bounds, view)) return;
    const bool culls = in.rule.culls && !is_inside(table.bounds, view);
    const auto draw = [&](int32_t c) {
        if (culls && is_outside(table.box[c], view)) return;
        out.instance.push_back(static_cast<int32_t>(i));
        out.cluster.push_back(c);
        out.num_gaussians += table.offset[c + 1] - table.offset[c];
    };
    if (top_fits(table, view, in.rule)) {
        for (const int32_t c : table.top_cluster) draw(c);
        return;
    }
    // Group -1 stands at both ends: below the leaves everything fits, above the roots nothing does.
    const size_t num_groups = table.ball.size;
    for (size_t g = 0; g < num_groups; ++g)
        fits_group[g] = fits(table, static_cast<int32_t>(g), view, in.rule);
    const size_t num_clusters = table.own_group.size;
    for (size_t c = 0; c < num_clusters; ++c) {
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        const bool own_fits = own < 0 || fits_group[own];
        const bool parent_fits = parent >= 0 && fits_group[parent];
        if (own_fits && !parent_fits) draw(static_cast<int32_t>(c));
    }
}

size_t most_groups(const SelectInput& in) {
    size_t most = 0;
    for (const ClusterTable& table : in.bundles) most = std::max(most, table.ball.size);
    return most;
}

}  // namespace

void cpu::select(const SelectInput& in, SelectOutput& out) {
    const size_t num_instances = in.instances.bundle.size;
    const size_t num_chunks = (num_instances + kChunk - 1) / kChunk;
    const size_t num_groups = most_groups(in);
    std::vector<SelectOutput> chunks(num_chunks);
    parallel_for(num_chunks, 1, [&](size_t k) {
        std::vector<uint8_t> fits_group(num_groups);
        for (size_t i = k * kChunk; i < std::min(num_instances, (k + 1) * kChunk); ++i)
            select_instance(in, i, fits_group, chunks[k]);
    });
    std::vector<size_t> first(num_chunks + 1, 0);
    for (size_t k = 0; k < num_chunks; ++k) {
        first[k + 1] = first[k] + chunks[k].instance.size();
        out.num_gaussians += chunks[k].num_gaussians;
    }
    out.instance.resize(first[num_chunks]);
    out.cluster.resize(first[num_chunks]);
    for (size_t k = 0; k < num_chunks; ++k) {
        std::copy(chunks[k].instance.begin(), chunks[k].instance.end(), out.instance.begin() + first[k]);
        std::copy(chunks[k].cluster.begin(), chunks[k].cluster.end(), out.cluster.begin() + first[k]);
    }
}

void cpu::group_metrics(const SelectInput& in, Span<const int64_t> metric_offset, Span<float> metric) {
    parallel_for(in.instances.bundle.size, kChunk, [&](size_t i) {
        const ClusterTable& table = in.bundles[in.instances.bundle[i]];
        const InstanceView view = view_from_instance(in.camera, in.instances.pose(i), table.pad_px);
        for (size_t g = 0; g < table.ball.size; ++g)
            metric[metric_offset[i] + g] = metric_px2(table, static_cast<int32_t>(g), view, in.rule);
    });
}

}  // namespace v3dg
