// Threads work on chunks of instances. What the decision asks of a group is answered once; its clusters then
// look it up.

#include "select/select.h"

#include <algorithm>
#include <utility>

#include "base/parallel_for.h"

namespace v3dg {

namespace {

constexpr size_t kChunk = 16;
constexpr size_t kBudgetParts = 16;

// Answers for the groups of one instance: whether each fits, or its bin.
struct KnownFits {
    const uint8_t* fits_group;

    bool fits(int32_t g) const { return fits_group[g] != 0; }
};
struct KnownBins {
    const uint32_t* bin_of_group;

    uint32_t bin(int32_t g) const { return bin_of_group[g]; }
};

// An instance in front of the camera. One without a pose is hidden.
struct SeenInstance {
    const ClusterTable& table;
    InstanceView view;
    bool is_placed;

    SeenInstance(const SelectInput& in, size_t i)
        : table(in.bundles[in.instances.bundle[i]]),
          view(),
          is_placed(v3dg::is_placed(in.instances.pose(i))) {
        if (!is_placed) return;
        const Pose pose = in.instances.pose(i);
        view = view_from_instance(in.camera, axes_of_instance(in.camera, pose), pose,
                                  in.instances.importance[i], table.pad_px);
    }

    CutSource source(const SelectRule& rule) const {
        return is_placed ? source_of_cut(table, view, rule, SIZE_MAX) : CutSource::nowhere;
    }

    // With answers that are filled in before clusters ask.
    template <class Groups>
    InstanceCut<Groups> cut(const SelectRule& rule, const Groups& groups) const {
        return {table, view, rule, groups, rule.culls && !is_inside(table.bounds, view)};
    }

    AskedGroups groups(const SelectRule& rule) const { return {table, view, rule}; }
};

// Appends what instance i draws. fits: scratch for as many groups as any bundle has.
void select_instance(const SelectInput& in, const SelectRule& rule, size_t i, std::vector<uint8_t>& fits,
                     SelectOutput& out) {
    const SeenInstance seen(in, i);
    const CutSource source = seen.source(rule);
    if (source == CutSource::nowhere) return;
    const auto cut = seen.cut(rule, KnownFits{fits.data()});
    const auto add = [&](size_t c) {
        out.instance.push_back(static_cast<int32_t>(i));
        out.cluster.push_back(static_cast<int32_t>(c));
        out.num_gaussians += seen.table.num_gaussians(c);
    };
    if (source == CutSource::tops) {
        for (const int32_t c : seen.table.top_cluster)
            if (!cut.is_culled(c)) add(c);
        return;
    }
    const AskedGroups groups = seen.groups(rule);
    const size_t num_groups = seen.table.ball.size, num_clusters = seen.table.num_clusters();
    for (size_t g = 0; g < num_groups; ++g) fits[g] = groups.fits(static_cast<int32_t>(g));
    for (size_t c = 0; c < num_clusters; ++c)
        if (cut.draws(c)) add(c);
}

size_t most_groups(const SelectInput& in) {
    size_t most = 0;
    for (const ClusterTable& table : in.bundles) most = std::max(most, table.ball.size);
    return most;
}

// Adds to `change`, for each tolerance that a budget chooses from, by how many gaussians the cut of instance
// i differs from that of the tolerance before. bins: as above.
void count_instance(const SelectInput& in, size_t i, std::vector<uint32_t>& bins,
                    std::vector<int64_t>& change) {
    const SeenInstance seen(in, i);
    const CutSource source = seen.source(in.rule);
    if (source == CutSource::nowhere) return;
    const auto cut = seen.cut(in.rule, KnownBins{bins.data()});
    if (source == CutSource::tops) {
        for (const int32_t c : seen.table.top_cluster)
            if (!cut.is_culled(c)) change[0] += seen.table.num_gaussians(c);
        return;
    }
    const AskedGroups groups = seen.groups(in.rule);
    for (size_t g = 0; g < seen.table.ball.size; ++g) bins[g] = groups.bin(static_cast<int32_t>(g));
    for (size_t c = 0; c < seen.table.num_clusters(); ++c) {
        const BinRange range = cut.bins(c);
        if (range.is_empty()) continue;
        change[range.first] += seen.table.num_gaussians(c);
        change[range.end] -= seen.table.num_gaussians(c);
    }
}

// Sets the tolerance of `rule`. Returns how many gaussians its cut has; more than the budget where no cut
// fits.
int64_t meet_budget(const SelectInput& in, SelectRule& rule) {
    const size_t num_instances = in.instances.bundle.size, num_groups = most_groups(in);
    // Each part takes every kBudgetParts-th instance, because neighbours cost about the same.
    std::vector<std::vector<int64_t>> changes(std::min(kBudgetParts, num_instances));
    parallel_for(changes.size(), 1, [&](size_t part) {
        changes[part].assign(kNumBudgetBins + 1, 0);
        std::vector<uint32_t> bins(num_groups);
        for (size_t i = part; i < num_instances; i += changes.size())
            count_instance(in, i, bins, changes[part]);
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
        std::vector<uint8_t> fits(num_groups);
        for (size_t i = k * kChunk; i < std::min(num_instances, (k + 1) * kChunk); ++i)
            select_instance(in, rule, i, fits, chunks[k]);
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

void cpu::bounds_may_draw(const SelectInput& in, Tolerances tolerances, Span<const int64_t> first,
                          Span<uint8_t> may_draw) {
    std::vector<std::vector<ClusterBounds>> bounds;
    for (const ClusterTable& table : in.bundles) bounds.push_back(bounds_of_clusters(table));
    parallel_for(in.instances.bundle.size, kChunk, [&](size_t i) {
        const SeenInstance seen(in, i);
        uint8_t* out = may_draw.data + first[i];
        for (const ClusterBounds& b : bounds[in.instances.bundle[i]])
            *out++ = seen.is_placed && v3dg::may_draw(b, seen.view, in.rule, tolerances);
    });
}

}  // namespace v3dg
