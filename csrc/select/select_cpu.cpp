// Selection on the CPU. Threads process chunks of instances. For each instance, the
// refinement of each group is computed once, and the clusters then look it up. So the
// decision about a cluster takes two passes (select_math.h).

#include "select/select.h"

#include <algorithm>
#include <cstring>
#include <numeric>
#include <utility>

#include "base/parallel_for.h"

namespace v3dg {

namespace {

constexpr size_t kChunk = 16;
constexpr size_t kBudgetParts = 16;
// From this number of instances on, the runs of a bundle are computed. Computing the
// runs costs about as much as processing one instance.
constexpr size_t kManyInstances = 16;

// Stored states of the groups of one instance: how far each group is refined, and its
// bins.
struct KnownRefinements {
    const uint16_t* of_group;

    int32_t refinement(int32_t g) const { return of_group[g]; }
};
struct GroupBins {
    uint32_t fitting, unrefined;
};
struct KnownBins {
    const GroupBins* of_group;

    uint32_t first_fitting(int32_t g) const { return of_group[g].fitting; }
    uint32_t first_unrefined(int32_t g) const { return of_group[g].unrefined; }
};

// The input of a selection, and values that all instances share.
struct View {
    const SelectInput& in;
    std::vector<CameraSides> sides;  // one per bundle
    std::vector<ClusterRuns> own_runs;
    // One element per bundle, set by find_runs(). It is empty if there are few
    // instances.
    Span<const ClusterRuns> runs;
    size_t most_groups = 0, most_clusters = 0;  // maxima over all bundles

    explicit View(const SelectInput& input) : in(input) {
        for (const ClusterTable& table : in.bundles) {
            sides.push_back(sides_of_eyes(in.eyes, table.pad_px));
            most_groups = std::max(most_groups, table.ball.size);
            most_clusters = std::max(most_clusters, table.num_clusters());
        }
    }

    void find_runs() {
        if (in.runs.empty()) own_runs = runs_of_bundles(in.bundles, in.instances, 1);
        runs = in.runs;
        if (in.runs.empty()) runs = {own_runs.data(), own_runs.size()};
    }
};

// The clusters of a table that must be tested, and a range that contains all of their
// groups.
struct Asked {
    ClusterRange clusters, groups;
};

// An instance in front of the camera. Its source is CutSource::nowhere if it is not
// drawn.
struct SeenInstance {
    const ClusterTable& table;
    InstanceView view;
    bool is_drawn;

    V3DG_INLINE SeenInstance(const View& of, size_t i)
        : table(of.in.bundles[of.in.instances.bundle[i]]), view(), is_drawn(false) {
        const InstanceTable& instances = of.in.instances;
        const Pose pose = instances.pose(i);
        is_drawn = instances.is_drawn(i);
        if (is_drawn)
            view = view_from_instance(of.in.eyes, of.sides[instances.bundle[i]],
                                      axes_of_instance(of.in.eyes.camera[0], pose), pose,
                                      instances.importance[i]);
    }

    CutSource source(const SelectRule& rule) const {
        return is_drawn ? source_of_cut(table, view, rule, SIZE_MAX) : CutSource::nowhere;
    }

    // Returns the decisions of this instance. `groups` has the states of the groups;
    // they may be filled in later.
    template <class Groups>
    InstanceCut<Groups> cut(const SelectRule& rule, const Groups& groups) const {
        return {table, view, rule, groups, rule.culls && !is_inside(table.bounds, view)};
    }

    AskedGroups groups(const SelectRule& rule) const { return {table, view, rule}; }

    // Returns the clusters and the groups that must be tested at these tolerances.
    Asked asked(const View& of, size_t i, const SelectRule& rule, Tolerances tolerances) const {
        const ClusterRuns& runs = of.runs[of.in.instances.bundle[i]];
        Asked asked{{0, static_cast<uint32_t>(table.num_clusters())},
                    {0, static_cast<uint32_t>(table.ball.size)}};
        if (runs.count == 0 || !table.pages.is_whole()) return asked;
        asked.clusters = clusters_to_ask(table, runs, view, rule, tolerances);
        // If most clusters must be tested, they belong to most groups. Finding the
        // range of these groups would then cost more than testing all groups.
        if (asked.clusters.end - asked.clusters.first > table.num_clusters() / 2) return asked;
        int32_t first = static_cast<int32_t>(table.ball.size), last = -1;
        for (uint32_t c = asked.clusters.first; c < asked.clusters.end; ++c) {
            const int32_t own = table.own_group[c], parent = table.parent_group[c];
            first = std::min(first, own >= 0 ? own : parent >= 0 ? parent : first);
            last = std::max({last, own, parent});
        }
        asked.groups = {static_cast<uint32_t>(std::min(first, last + 1)),
                        static_cast<uint32_t>(last + 1)};
        return asked;
    }
};

// The temporary memory of a thread.
struct Scratch {
    std::vector<uint16_t> refinement;  // one element per group
    std::vector<int32_t> chosen;       // selected clusters
    std::vector<float> priority;       // one element per group, if needs are requested

    explicit Scratch(const View& view)
        : refinement(view.most_groups),
          chosen(view.most_clusters),
          priority(view.in.needs.empty() ? 0 : view.most_groups) {}
};

// Computes the refinement of an instance's groups. The inputs are passed by value,
// which shows the compiler that no write changes them, so that it vectorises the first
// loop. Testing for residency would prevent this, so a second loop handles groups whose
// page is absent or fading in.
template <Footprint footprint, bool kFades>
void ask_groups(ClusterTable table, const InstanceView view, SelectRule rule,
                const ClusterRange asked, uint16_t* __restrict refinement) {
    rule.footprint = footprint;
    if (!kFades) rule.fade = {};
    const PageTable pages = table.pages;
    table.pages = {};
    const AskedGroups groups{table, view, rule};
    const auto first = static_cast<int32_t>(asked.first), end = static_cast<int32_t>(asked.end);
    for (int32_t g = first; g < end; ++g)
        refinement[g] = static_cast<uint16_t>(groups.refinement(g));
    for (int32_t g = first; g < end && !pages.is_whole(); ++g) {
        const int32_t most = pages.is_resident(g) ? arrival(pages, g, rule) : 0;
        refinement[g] = static_cast<uint16_t>(min_of<int32_t>(refinement[g], most));
    }
}

void ask_groups(const SeenInstance& seen, const SelectRule& rule, const ClusterRange& asked,
                uint16_t* refinement) {
    if (rule.footprint == Footprint::paper)
        ask_groups<Footprint::paper, false>(seen.table, seen.view, rule, asked, refinement);
    else if (rule.fade.is_on())
        ask_groups<Footprint::solid_angle, true>(seen.table, seen.view, rule, asked, refinement);
    else
        ask_groups<Footprint::solid_angle, false>(seen.table, seen.view, rule, asked, refinement);
}

// The first pass of the decision. Writes the clusters with a positive weight, and
// returns their number.
size_t find_sufficient(const ClusterTable table, const InstanceView view, const SelectRule rule,
                       const ClusterRange asked, const uint16_t* __restrict refinement,
                       int32_t* __restrict cluster) {
    const InstanceCut<KnownRefinements> cut{table, view, rule, {refinement}, false};
    size_t num_sufficient = 0;
    // The loop is branch-free, because a branch would often be mispredicted.
    for (size_t c = asked.first; c < asked.end; ++c) {
        cluster[num_sufficient] = static_cast<int32_t>(c);
        num_sufficient += cut.weight(c) > 0;
    }
    return num_sufficient;
}

// Raises `need` to the bits of `priority` if it is lower. Several threads may do so
// concurrently. Bits of positive floats have the same order as the floats.
void raise(uint32_t& need, float priority) {
    uint32_t bits, before = __atomic_load_n(&need, __ATOMIC_RELAXED);
    std::memcpy(&bits, &priority, sizeof bits);
    while (before < bits && !__atomic_compare_exchange_n(&need, &before, bits, true,
                                                         __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
    }
}

// Records which pages an instance needs. `needs` has one element per page.
template <class Cut>
void tell_needs(const Cut& cut, const SelectRule& rule, Span<uint32_t> needs,
                std::vector<float>& priority) {
    const ClusterTable& table = cut.table;
    for (size_t g = 0; g < table.ball.size; ++g)
        priority[g] =
            priority_of(wanted_metric_px2(table, static_cast<int32_t>(g), cut.view, rule), rule);
    for (size_t c = 0; c < table.num_clusters(); ++c) {
        const PageNeed need = page_need(table, c, [&](int32_t g) { return priority[g]; });
        if (need.page >= 0 && !cut.is_culled(c)) raise(needs[need.page], need.priority);
    }
}

// Appends the clusters that instance i draws.
void select_instance(const View& view, const SelectRule& rule, size_t i, Scratch& scratch,
                     SelectOutput& out) {
    const SeenInstance seen(view, i);
    const CutSource source = seen.source(rule);
    if (source == CutSource::nowhere) return;
    uint16_t* refinement = scratch.refinement.data();
    const auto cut = seen.cut(rule, KnownRefinements{refinement});
    int32_t* chosen = scratch.chosen.data();
    int32_t* end = chosen;
    if (source == CutSource::tops) {
        end = std::copy(seen.table.top_cluster.begin(), seen.table.top_cluster.end(), chosen);
    } else {
        const Asked asked = seen.asked(view, i, rule, Tolerances::this_one);
        ask_groups(seen, rule, asked.groups, refinement);
        end += find_sufficient(seen.table, seen.view, rule, asked.clusters, refinement, chosen);
        if (!view.in.needs.empty() && !seen.table.pages.is_whole())
            tell_needs(cut, rule, view.in.needs[view.in.instances.bundle[i]], scratch.priority);
    }
    if (cut.culls) end = std::remove_if(chosen, end, [&](int32_t c) { return cut.is_culled(c); });
    out.instance.insert(out.instance.end(), end - chosen, static_cast<int32_t>(i));
    out.cluster.insert(out.cluster.end(), chosen, end);
    if (rule.fade.is_on())
        for (const int32_t* c = chosen; c != end; ++c)
            out.weight.push_back(source == CutSource::tops ? 1.0f : share_of(cut.weight(*c)));
    out.num_gaussians += std::accumulate(chosen, end, int64_t(0), [&](int64_t sum, int32_t c) {
        return sum + seen.table.num_gaussians(c);
    });
}

// Adds the cut of instance i to `change`. For each bin, this adds the number of
// gaussians by which the cut differs from that of the bin before. `bins` must have room
// for all groups.
void count_instance(const View& view, size_t i, std::vector<GroupBins>& bins,
                    std::vector<int64_t>& change) {
    const SelectRule& rule = view.in.rule;
    const SeenInstance seen(view, i);
    const CutSource source = seen.source(rule);
    if (source == CutSource::nowhere) return;
    const auto cut = seen.cut(rule, KnownBins{bins.data()});
    if (source == CutSource::tops) {
        for (const int32_t c : seen.table.top_cluster)
            if (!cut.is_culled(c)) change[0] += seen.table.num_gaussians(c);
        return;
    }
    const AskedGroups groups = seen.groups(rule);
    const Asked asked = seen.asked(view, i, rule, Tolerances::from_this_on);
    for (uint32_t g = asked.groups.first; g < asked.groups.end; ++g) {
        const auto group = static_cast<int32_t>(g);
        bins[g] = {groups.first_fitting(group), groups.first_unrefined(group)};
    }
    for (size_t c = asked.clusters.first; c < asked.clusters.end; ++c) {
        const BinRange range = cut.bins(c);
        if (range.is_empty()) continue;
        change[range.first] += seen.table.num_gaussians(c);
        change[range.end] -= seen.table.num_gaussians(c);
    }
}

// Several arrays. For each bin, their sum is the number of gaussians by which the cut
// differs from that of the bin before.
using BinChanges = std::vector<std::vector<int64_t>>;
BinChanges count_changes(const View& view) {
    const size_t num_instances = view.in.instances.bundle.size;
    // Part p has the instances p, p + kBudgetParts, and so on. Consecutive instances
    // cost about the same, so this balances the load.
    BinChanges changes(std::min(kBudgetParts, num_instances));
    parallel_for(changes.size(), 1, [&](size_t part) {
        changes[part].assign(kNumBudgetBins + 1, 0);
        std::vector<GroupBins> bins(view.most_groups);
        for (size_t i = part; i < num_instances; i += changes.size())
            count_instance(view, i, bins, changes[part]);
    });
    return changes;
}

// Sets the tolerance of `rule` to meet its budget. Returns whether any cut fits. If
// none fits, `least_count` receives the number of gaussians in the coarsest cut.
bool meet_budget(const View& view, SelectRule& rule, int64_t& least_count) {
    const BinChanges changes = count_changes(view);
    const uint64_t goal_count = goal_of_budget(rule.budget);
    uint32_t least = 0, goal = 0, none = kNoBin;
    for (uint32_t bin = 0; bin < kNumBudgetBins; ++bin) {
        for (const std::vector<int64_t>& change : changes) least_count += change[bin];
        if (static_cast<uint64_t>(least_count) > rule.budget) least = bin + 1;
        if (static_cast<uint64_t>(least_count) > goal_count) goal = bin + 1;
    }
    if (least == kNumBudgetBins) return false;
    uint32_t* last = view.in.last_bin == nullptr ? &none : view.in.last_bin;
    rule.tolerance_px2 = tolerance_of_budget(rule, least, goal, *last);
    return true;
}

}  // namespace

std::vector<ClusterRuns> runs_of_bundles(Span<const ClusterTable> bundles,
                                         const InstanceTable& instances, size_t num_cuts) {
    std::vector<size_t> count(bundles.size, 0);
    for (const int32_t b : instances.bundle) count[b] += num_cuts;
    std::vector<ClusterRuns> runs(bundles.size);
    parallel_for(runs.size(), 1, [&](size_t b) {
        if (count[b] >= kManyInstances) runs[b] = runs_of_clusters(bundles[b]);
    });
    return runs;
}

void cpu::select(const SelectInput& in, SelectOutput& out) {
    View view(in);
    view.find_runs();
    SelectRule rule = in.rule;
    if (rule.budget != kNoBudget) {
        out.num_gaussians = 0;
        out.fits_budget = meet_budget(view, rule, out.num_gaussians);
        if (!out.fits_budget) return;
    }
    out.tolerance_px2 = rule.tolerance_px2;
    out.num_gaussians = 0;
    const size_t num_instances = in.instances.bundle.size;
    const size_t num_chunks = (num_instances + kChunk - 1) / kChunk;
    std::vector<SelectOutput> chunks(num_chunks);
    parallel_for(num_chunks, 1, [&](size_t k) {
        Scratch scratch(view);
        for (size_t i = k * kChunk; i < std::min(num_instances, (k + 1) * kChunk); ++i)
            select_instance(view, rule, i, scratch, chunks[k]);
    });
    std::vector<size_t> first(num_chunks + 1, 0);
    for (size_t k = 0; k < num_chunks; ++k) {
        first[k + 1] = first[k] + chunks[k].instance.size();
        out.num_gaussians += chunks[k].num_gaussians;
    }
    out.instance.resize(first[num_chunks]);
    out.cluster.resize(first[num_chunks]);
    out.weight.resize(rule.fade.is_on() ? first[num_chunks] : 0);
    for (size_t k = 0; k < num_chunks; ++k) {
        std::copy(chunks[k].instance.begin(), chunks[k].instance.end(),
                  out.instance.begin() + first[k]);
        std::copy(chunks[k].cluster.begin(), chunks[k].cluster.end(),
                  out.cluster.begin() + first[k]);
        std::copy(chunks[k].weight.begin(), chunks[k].weight.end(), out.weight.begin() + first[k]);
    }
}

void cpu::choose_tolerances(const SelectInput& in, Span<const uint64_t> budgets,
                            Span<BudgetCut> chosen) {
    View view(in);
    view.find_runs();
    const BinChanges changes = count_changes(view);
    // A bin at which the number of gaussians changes. There are few of these.
    struct Step {
        uint32_t bin;
        int64_t count;
    };
    std::vector<Step> steps{{0, 0}};
    for (uint32_t bin = 0; bin < kNumBudgetBins; ++bin) {
        int64_t change = 0;
        for (const std::vector<int64_t>& part : changes) change += part[bin];
        if (bin > 0 && change != 0) steps.push_back({bin, steps.back().count});
        steps.back().count += change;
    }
    for (size_t k = 0; k < budgets.size; ++k) {
        size_t least = steps.size();
        while (least > 0 && static_cast<uint64_t>(steps[least - 1].count) <= budgets[k]) --least;
        const bool fits = least < steps.size();
        chosen[k] = {
            .tolerance_px2 = fits ? tolerance_of_bin(steps[least].bin, in.rule.tolerance_px2) : 0,
            .fits = fits,
            .num_gaussians = steps[fits ? least : least - 1].count};
    }
}

void cpu::group_metrics(const SelectInput& in, Span<const int64_t> metric_offset,
                        Span<float> metric) {
    const View view(in);
    parallel_for(in.instances.bundle.size, kChunk, [&](size_t i) {
        const SeenInstance seen(view, i);
        for (size_t g = 0; g < seen.table.ball.size; ++g)
            metric[metric_offset[i] + g] =
                wanted_metric_px2(seen.table, static_cast<int32_t>(g), seen.view, in.rule);
    });
}

void cpu::pair_metrics(const SelectInput& in, const GivenCut& given, Span<float> metric) {
    const View view(in);
    parallel_for(metric.size, kChunk, [&](size_t s) {
        const SeenInstance seen(view, given.instance[s]);
        const int32_t group = seen.table.own_group[given.cluster[s]];
        const bool is_coarse = seen.is_drawn && group >= 0;
        metric[s] = is_coarse ? wanted_metric_px2(seen.table, group, seen.view, in.rule) : 0.0f;
    });
}

void cpu::bounds_may_draw(const SelectInput& in, Tolerances tolerances, Span<const int64_t> first,
                          Span<uint8_t> may_draw) {
    std::vector<std::vector<ClusterBounds>> bounds;
    std::vector<ClusterRuns> runs;
    for (const ClusterTable& table : in.bundles) {
        bounds.push_back(bounds_of_clusters(table));
        runs.push_back(runs_of_clusters(table));
    }
    const View view(in);
    std::fill(may_draw.begin(), may_draw.end(), uint8_t(0));
    parallel_for(in.instances.bundle.size, kChunk, [&](size_t i) {
        const SeenInstance seen(view, i);
        if (!seen.is_drawn) return;
        const int32_t bundle = in.instances.bundle[i];
        const ClusterRange asked =
            clusters_to_ask(seen.table, runs[bundle], seen.view, in.rule, tolerances);
        for (size_t k = asked.first / kClustersOfBounds; k * kClustersOfBounds < asked.end; ++k)
            may_draw[first[i] + k] =
                v3dg::may_draw(seen.table, bounds[bundle][k], seen.view, in.rule, tolerances);
    });
}

}  // namespace v3dg
