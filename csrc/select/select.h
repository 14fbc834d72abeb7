#pragma once

// Selection: the interface, and the functions for the CPU. select_math.h proves that
// cuts are exact.

#include <cstdint>
#include <vector>

#include "residency/instance_table.h"
#include "select/select_math.h"

namespace v3dg {

// Selects the clusters of all instances that are just detailed enough for one view:
// exactly one on each path from a leaf to its root. This requires that balls nest, and
// that weights never decrease towards the root. With two eyes, the clusters are
// detailed enough for the nearer eye. Footprint::paper is not allowed with two eyes,
// because it uses the depth of one camera.
//
// The selected pairs are ordered by instance, then by cluster. Pairs that cannot touch
// a pixel are omitted. The result has the same bits on the CPU and on CUDA, for any
// number of threads. A group whose page is absent is not refined.
//
// With a budget, the tolerance is the first bin (budget_math.h) from which on no cut
// has more gaussians than the budget. All larger bins must be checked, because a
// coarser cut can have more gaussians inside the frustum. If there is no such bin,
// `fits_budget` is false, nothing is selected, and `num_gaussians` counts the coarsest
// cut. The budget assumes that all pages are resident; if they are not, the cut may
// have more or fewer gaussians. With a fade, every cluster that may be drawn counts.
// With BudgetPace::in_steps, the tolerance also depends on the tolerance of the last
// frame, and is at least the first bin.
//
// With a fade, a path may have several clusters, whose weights add up to 1. A weight
// depends on the metrics of two groups, and on how far their pages have faded in.
//
// Source: Yang et al., Virtualized 3D Gaussians, SIGGRAPH 2025, online selection. The
// footprint and the nesting balls differ from the paper.
struct SelectInput {
    Span<const ClusterTable> bundles;
    InstanceTable instances;
    Eyes eyes;
    SelectRule rule;
    // Optional output for bundles with absent pages: [G + 1] per bundle, the bits of
    // the highest priority of each page (page_need.h), or 0 if the page is not needed.
    // Must initially be 0. If a span is empty, nothing is reported.
    Span<const Span<uint32_t>> needs = {};
    // State of tolerance_of_budget(). Only used with BudgetPace::in_steps.
    uint32_t* last_bin = nullptr;
    // The result of runs_of_bundles(), for callers that select many cuts. If it is
    // empty, each cut computes the runs itself.
    Span<const ClusterRuns> runs = {};
};

struct SelectOutput {
    std::vector<int32_t> instance, cluster;  // [S]
    std::vector<float> weight;               // [S]; empty without a fade, where all weights are 1
    int64_t num_gaussians = 0;
    float tolerance_px2 = 0;  // tolerance of the cut
    bool fits_budget = true;
};

// A cut that was selected earlier. If `weight` is empty, all weights are 1.
struct GivenCut {
    Span<const int32_t> instance, cluster;
    Span<const float> weight;

    V3DG_HD float weight_of(size_t s) const { return weight.size == 0 ? 1.0f : weight[s]; }
};

// The cut that results from a budget.
struct BudgetCut {
    float tolerance_px2;
    bool fits;              // false if even the coarsest cut exceeds the budget
    int64_t num_gaussians;  // with all pages resident; for the coarsest cut if none
                            // fits
};

// Returns the runs of each bundle, for use in `num_cuts` cuts. The runs of a bundle are
// empty if it has few instances in all cuts together.
std::vector<ClusterRuns> runs_of_bundles(Span<const ClusterTable> bundles,
                                         const InstanceTable& instances, size_t num_cuts);

namespace cpu {
void select(const SelectInput& in, SelectOutput& out);

// Finds the tolerances for several budgets in one view. Each result equals that of
// select() with the same budget. Several budgets cost hardly more than one.
void choose_tolerances(const SelectInput& in, Span<const uint64_t> budgets, Span<BudgetCut> chosen);

// Computes the metrics, px², of all groups of all instances. The metrics of instance i
// begin at metric_offset[i].
void group_metrics(const SelectInput& in, Span<const int64_t> metric_offset, Span<float> metric);

// For each pair, computes the metric, px², of the group that made the cluster. It is 0
// for clusters of level 0. All pairs must be in the scene.
void pair_metrics(const SelectInput& in, const GivenCut& given, Span<float> metric);

// Only for tests. For each instance and each kClustersOfBounds clusters, writes 0 if
// bounds alone show that none of the clusters is drawn at these tolerances, and
// otherwise 1. The values of instance i begin at first[i].
void bounds_may_draw(const SelectInput& in, Tolerances tolerances, Span<const int64_t> first,
                     Span<uint8_t> may_draw);
}  // namespace cpu

}  // namespace v3dg
