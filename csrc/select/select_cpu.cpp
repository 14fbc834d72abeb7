// A chunk of instances to a thread. Metrics are evaluated once a group; a cluster then reads what was found.

#include "select/select.h"

#include <algorithm>
#include <utility>

#include "base/parallel_for.h"

namespace v3dg {

namespace {

constexpr size_t kChunk = 16;
constexpr size_t kBudgetShares = 16;

struct SeenInstance {
    const ClusterTable& table;
    InstanceView view;
    bool is_hidden, culls;

    SeenInstance(const SelectInput& in, size_t i)
        : table(in.bundles[in.instances.bundle[i]]), view(), is_hidden(true), culls(false) {
        const Pose pose = in.instances.pose(i);
        if (!is_placed(pose)) return;
        view = view_from_instance(in.camera, axes_of_instance(in.camera, pose), pose,
                                  in.instances.importance[i], table.pad_px);
        is_hidden = in.rule.culls && is_outside(table.bounds, view);
        culls = in.rule.culls && !is_inside(table.bounds, view);
    }

    bool draws(size_t c) const { return !culls || !is_outside(table.box[c], view); }
    int64_t size(size_t c) const { return table.offset[c + 1] - table.offset[c]; }
};

// Appends what instance i draws. fits_group: scratch for as many groups as any bundle has.
void select_instance(const SelectInput& in, const SelectRule& rule, size_t i,
                     std::vector<uint8_t>& fits_group, SelectOutput& out) {
    const SeenInstance seen(in, i);
    if (seen.is_hidden) return;
    const ClusterTable& table = seen.table;
    const auto draw = [&](int32_t c) {
        if (!seen.draws(c)) return;
        out.instance.push_back(static_cast<int32_t>(i));
        out.cluster.push_back(c);
        out.num_gaussians += seen.size(c);
    };
    if (top_fits(table, seen.view, rule)) {
        for (const int32_t c : table.top_cluster) draw(c);
        return;
    }
    // Group -1 stands at both ends: below the leaves everything fits, above the roots nothing does.
    const size_t num_groups = table.ball.size;
    for (size_t g = 0; g < num_groups; ++g)
        fits_group[g] = fits(table, static_cast<int32_t>(g), seen.view, rule);
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

// Adds to `change`, for each tolerance that a budget chooses from, by how many gaussians the cut of instance
// i differs from that of the tolerance before.
void count_instance(const SelectInput& in, size_t i, std::vector<uint32_t>& bins,
                    std::vector<int64_t>& change) {
    const SeenInstance seen(in, i);
    if (seen.is_hidden) return;
    const ClusterTable& table = seen.table;
    if (top_fits(table, seen.view, in.rule)) {
        for (const int32_t c : table.top_cluster)
            if (seen.draws(c)) change[0] += seen.size(c);
        return;
    }
    for (size_t g = 0; g < table.ball.size; ++g)
        bins[g] = bin_of_group(table, static_cast<int32_t>(g), seen.view, in.rule);
    for (size_t c = 0; c < table.own_group.size; ++c) {
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        const uint32_t first = own < 0 ? 0 : bins[own], last = parent < 0 ? kNumBudgetBins : bins[parent];
        if (first >= last || !seen.draws(c)) continue;
        change[first] += seen.size(c);
        change[last] -= seen.size(c);
    }
}

// Sets the tolerance of `rule`. Returns how many gaussians its cut has; more than the budget where no cut
// fits.
int64_t meet_budget(const SelectInput& in, SelectRule& rule) {
    const size_t num_instances = in.instances.bundle.size, num_groups = most_groups(in);
    // Shares of the instances, dealt out in turn, since neighbours cost alike.
    std::vector<std::vector<int64_t>> changes(std::min(kBudgetShares, num_instances));
    parallel_for(changes.size(), 1, [&](size_t share) {
        changes[share].assign(kNumBudgetBins + 1, 0);
        std::vector<uint32_t> bins(num_groups);
        for (size_t i = share; i < num_instances; i += changes.size())
            count_instance(in, i, bins, changes[share]);
    });
    int64_t count = 0, chosen_count = 0;
    uint32_t chosen = 0;
    for (uint32_t bin = 0; bin < kNumBudgetBins; ++bin) {
        for (const std::vector<int64_t>& change : changes) count += change[bin];
        if (static_cast<uint64_t>(count) > rule.budget)
            chosen = bin + 1;
        else if (bin == chosen)
            chosen_count = count;
    }
    if (chosen == kNumBudgetBins) return count;
    rule.tolerance_px2 = tolerance_of_bin(chosen, in.rule.tolerance_px2);
    return chosen_count;
}

}  // namespace

void cpu::select(const SelectInput& in, SelectOutput& out) {
    SelectRule rule = in.rule;
    if (rule.budget != kNoBudget) {
        out.num_gaussians = meet_budget(in, rule);
        out.fits_budget = static_cast<uint64_t>(out.num_gaussians) <= rule.budget;
        if (!out.fits_budget) return;
    }
    out.tolerance_px2 = rule.tolerance_px2;
    out.num_gaussians = 0;
    const size_t num_instances = in.instances.bundle.size;
    const size_t num_chunks = (num_instances + kChunk - 1) / kChunk;
    const size_t num_groups = most_groups(in);
    std::vector<SelectOutput> chunks(num_chunks);
    parallel_for(num_chunks, 1, [&](size_t k) {
        std::vector<uint8_t> fits_group(num_groups);
        for (size_t i = k * kChunk; i < std::min(num_instances, (k + 1) * kChunk); ++i)
            select_instance(in, rule, i, fits_group, chunks[k]);
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
        const SeenInstance seen(in, i);
        for (size_t g = 0; g < seen.table.ball.size; ++g)
            metric[metric_offset[i] + g] =
                metric_px2(seen.table, static_cast<int32_t>(g), seen.view, in.rule);
    });
}

}  // namespace v3dg
