#pragma once

// Contract of selection, and its CPU half. select_math.h says why a cut is exact.

#include <cstdint>
#include <vector>

#include "residency/instance_table.h"
#include "select/select_math.h"

namespace v3dg {

// Chooses the clusters of all instances that are just detailed enough for one view:
// exactly one on every path from a leaf to its root, when balls nest and weights never
// decrease towards the root. For two eyes they are detailed enough for the nearer one.
// The paper's footprint, which uses the depth of one camera, does not allow two.
//
// Selected pairs are in ascending order of instance, then cluster. Pairs outside the
// frustum are left out, unless they could touch a pixel. Both halves give the same bits
// for any number of threads.
//
// Groups whose page is not resident are not refined.
//
// With a budget, the tolerance is the smallest bin (budget_math.h) from which on no cut
// has more gaussians than the budget: a coarser cut can have more than a finer one
// where the frustum cuts through it. There may be none: then `fits_budget` is false,
// nothing is selected, and `num_gaussians` is that of the coarsest cut. All pages count
// as resident: while some are not, the cut may have more or fewer gaussians. With a
// fade, every cluster that may be drawn at a tolerance counts. In steps, the tolerance
// also depends on that of the frame before, and is never below that smallest bin.
//
// With a fade there may be several clusters on a path. Their weights add up to 1,
// whichever pages are resident and however far they have faded in, and depend only on
// that and on the metrics of the groups above and below.
//
// Source: Yang et al., Virtualized 3D Gaussians, SIGGRAPH 2025, online selection; the
// footprint and the nesting balls are ours.
struct SelectInput {
    Span<const ClusterTable> bundles;
    InstanceTable instances;
    Eyes eyes;
    SelectRule rule;
    // Receives which pages are needed, for bundles of which only some pages are
    // resident: [G + 1] a bundle, the bits of the highest priority of each page
    // (page_need.h). They start as 0, which means that a page is not needed. Empty
    // where they are not wanted.
    Span<const Span<uint32_t>> needs = {};
    uint32_t* last_bin = nullptr;  // for a budget in steps: the state of tolerance_of_budget()
};

struct SelectOutput {
    std::vector<int32_t> instance, cluster;  // [S]
    std::vector<float> weight;               // [S]; empty without a fade, where all are 1
    int64_t num_gaussians = 0;
    float tolerance_px2 = 0;  // the tolerance that was used
    bool fits_budget = true;
};

// Pairs that were selected before. `weight` is empty where all are 1.
struct GivenCut {
    Span<const int32_t> instance, cluster;
    Span<const float> weight;

    V3DG_HD float weight_of(size_t s) const { return weight.size == 0 ? 1.0f : weight[s]; }
};

namespace cpu {
void select(const SelectInput& in, SelectOutput& out);

// Writes the metric of every group of every instance, px2. Those of instance i begin at
// metric_offset[i].
void group_metrics(const SelectInput& in, Span<const int64_t> metric_offset, Span<float> metric);

// Writes the metric of the group that made the cluster of each pair, px2; 0 where the
// cluster is of level 0. The pairs are of the whole scene.
void pair_metrics(const SelectInput& in, const GivenCut& given, Span<float> metric);

// Writes what bounds show without asking a cluster, for tests: for each run of
// kClustersOfBounds clusters of every instance, 0 if none of them is drawn at these
// tolerances, else 1. Those of instance i begin at first[i].
void bounds_may_draw(const SelectInput& in, Tolerances tolerances, Span<const int64_t> first,
                     Span<uint8_t> may_draw);
}  // namespace cpu

}  // namespace v3dg
