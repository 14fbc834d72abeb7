#pragma once

#include <cstdint>
#include <vector>

#include "residency/instance_table.h"
#include "select/view_math.h"

namespace v3dg {

// Chooses the clusters of all instances that are just detailed enough for one view: exactly one on
// every path from a leaf to its root, when balls nest and weights never decrease towards the root.
// For two eyes, they are detailed enough for the nearer one; not with the paper's footprint, which
// has one camera's depth.
//
// Selected pairs are in ascending order of instance, then cluster. Pairs outside the frustum are
// left out, unless they could touch a pixel. Both halves give the same bits for any number of
// threads.
//
// Groups whose page is not resident are not refined.
//
// With a budget, the tolerance is the least of those that a budget chooses from (select_math.h)
// from which on no cut has more gaussians: a coarser cut can have more than a finer one where the
// frustum cuts through it. There may be none: then `fits_budget` is false, nothing is selected and
// `num_gaussians` is what the coarsest cut has. All pages count as resident: while some are not,
// the cut may have more or less. With a fade, what counts at a tolerance is every cluster that may
// be drawn. In steps, a tolerance above that least one is used, which comes from that of the frame
// before (select_math.h).
//
// With a fade there may be several clusters on a path, whose weights add up to 1, whichever pages
// are resident and however far they have faded in. They depend on that and on the metrics of the
// groups above and below alone.
//
// Source: Yang et al., Virtualized 3D Gaussians, SIGGRAPH 2025, online selection; the footprint and
// the nesting balls are ours.
struct SelectInput {
    Span<const ClusterTable> bundles;
    InstanceTable instances;
    Eyes eyes;
    SelectRule rule;
    // Where it is told which pages are needed, of the bundles of which only some are resident: [G +
    // 1] of each, bits of the highest priority of each page (select_math.h), 0 where it is not
    // needed and before. Empty: nobody asks.
    Span<const Span<uint32_t>> needs = {};
    uint32_t* last_bin = nullptr;  // of a budget in steps: what tolerance_of_budget() keeps
};

struct SelectOutput {
    std::vector<int32_t> instance, cluster;  // [S]
    std::vector<float> weight;               // [S]; none without a fade, where all are 1
    int64_t num_gaussians = 0;
    float tolerance_px2 = 0;  // that was used
    bool fits_budget = true;
};

// What was selected before. No weights where all are 1.
struct GivenCut {
    Span<const int32_t> instance, cluster;
    Span<const float> weight;

    V3DG_HD float weight_of(size_t s) const { return weight.size == 0 ? 1.0f : weight[s]; }
};

namespace cpu {
void select(const SelectInput& in, SelectOutput& out);

// Metric of every group of every instance, px2. The bundle of instance i has its metrics at
// metric_offset[i].
void group_metrics(const SelectInput& in, Span<const int64_t> metric_offset, Span<float> metric);

// Metric of the group that made the cluster of each pair, px2; 0 where it is of level 0. Pairs are
// the scene's.
void pair_metrics(const SelectInput& in, const GivenCut& given, Span<float> metric);

// What bounds tell without asking a cluster: for each kClustersOfBounds neighbours of the table of
// every instance, 0 if none of them is drawn at these tolerances, else 1. Those of instance i begin
// at first[i].
void bounds_may_draw(const SelectInput& in, Tolerances tolerances, Span<const int64_t> first,
                     Span<uint8_t> may_draw);
}  // namespace cpu

}  // namespace v3dg
