#pragma once

// The contract of selection, and its CPU implementation. select_math.h proves that a
// cut is exact.

#include <cstdint>
#include <vector>

#include "residency/instance_table.h"
#include "select/select_math.h"

namespace v3dg {

// Chooses the clusters of all instances that are just detailed enough for one view:
// exactly one on every path from a leaf to its root, provided that balls nest and
// weights never decrease towards the root. With two eyes, the clusters are detailed
// enough for the nearer eye. The paper's footprint uses the depth of one camera, so it
// does not allow two eyes.
//
// Selected pairs are in ascending order of instance, then cluster. Pairs outside the
// frustum are left out, unless they could touch a pixel. The CPU and CUDA give the same
// bits, for any number of threads.
//
// Groups whose page is not resident are not refined.
//
// With a budget, the tolerance is the smallest bin (budget_math.h) from which on no cut
// has more gaussians than the budget. A larger tolerance alone does not guarantee fewer
// gaussians, because a coarser cut can have more of them inside the frustum. If there
// is no such bin, `fits_budget` is false, nothing is selected, and `num_gaussians` is
// that of the coarsest cut. The budget counts all pages as resident; while some are
// not, the cut may have more or fewer gaussians. With a fade, every cluster that may be
// drawn at a tolerance counts. In steps, the tolerance also depends on that of the
// frame before, and is never below the smallest bin.
//
// With a fade there may be several clusters on a path, whose weights add up to 1. The
// weights depend only on the metrics of the groups above and below, and on which pages
// are resident and how far they have faded in.
//
// Source: Yang et al., Virtualized 3D Gaussians, SIGGRAPH 2025, online selection; the
// footprint and the nesting balls are ours.
struct SelectInput {
    Span<const ClusterTable> bundles;
    InstanceTable instances;
    Eyes eyes;
    SelectRule rule;
    // Output for bundles of which only some pages are resident: [G + 1] per bundle, the
    // bits of the highest priority of each page (page_need.h). The elements start as 0,
    // which means that a page is not needed. Empty if not requested.
    Span<const Span<uint32_t>> needs = {};
    uint32_t* last_bin = nullptr;  // for a budget in steps: the state of tolerance_of_budget()
    // As runs_of_bundles() returns them, for callers that select many cuts; if empty, each
    // cut finds them anew.
    Span<const ClusterRuns> runs = {};
};

struct SelectOutput {
    std::vector<int32_t> instance, cluster;  // [S]
    std::vector<float> weight;               // [S]; empty without a fade, where all are 1
    int64_t num_gaussians = 0;
    float tolerance_px2 = 0;  // the tolerance that was used
    bool fits_budget = true;
};

// Pairs that were selected earlier. `weight` is empty if all weights are 1.
struct GivenCut {
    Span<const int32_t> instance, cluster;
    Span<const float> weight;

    V3DG_HD float weight_of(size_t s) const { return weight.size == 0 ? 1.0f : weight[s]; }
};

// The cut that meets a budget.
struct BudgetCut {
    float tolerance_px2;
    bool fits;              // whether any cut does; if not, the number is that of the coarsest one
    int64_t num_gaussians;  // before pages that are not resident and fades change it
};

// Returns the runs of each bundle for this number of cuts; empty for bundles with few
// instances in all cuts together.
std::vector<ClusterRuns> runs_of_bundles(Span<const ClusterTable> bundles,
                                         const InstanceTable& instances, size_t num_cuts);

namespace cpu {
void select(const SelectInput& in, SelectOutput& out);

// Finds the tolerance for each of several budgets of one view at once, as select() does
// for the budget of its rule. Costs little more than one of them.
void choose_tolerances(const SelectInput& in, Span<const uint64_t> budgets, Span<BudgetCut> chosen);

// Writes the metric of every group of every instance, px2. The metrics of instance i
// begin at metric_offset[i].
void group_metrics(const SelectInput& in, Span<const int64_t> metric_offset, Span<float> metric);

// Writes the metric of the group that made the cluster of each pair, px2; 0 for
// clusters of level 0. The pairs are of the whole scene.
void pair_metrics(const SelectInput& in, const GivenCut& given, Span<float> metric);

// For tests: writes 0 for each run of kClustersOfBounds clusters of every instance if
// bounds alone show that none of them is drawn at these tolerances, else 1. The values
// of instance i begin at first[i].
void bounds_may_draw(const SelectInput& in, Tolerances tolerances, Span<const int64_t> first,
                     Span<uint8_t> may_draw);
}  // namespace cpu

}  // namespace v3dg
