#pragma once

// The second kernel of a cut. It tests the clusters of parts, and writes those that are
// drawn.

#include "base/scan.cuh"
#include "select/cut_parts.cuh"
#include "select/cut_scratch.cuh"
#include "select/page_needs.cuh"
#include "select/write_clusters.cuh"

namespace v3dg {
namespace cuda {

constexpr unsigned kCutBlocks = 4;  // resident blocks of cut_kernel per multiprocessor
// resident blocks of place_kernel per multiprocessor
constexpr unsigned kPlaceBlocks = 12;

// Tests and writes clusters. If `kTells`, it also records which pages are needed.
template <class Output, bool kTells>
static __global__ void __launch_bounds__(kCutThreads, kCutBlocks)
    cut_kernel(PlacedScene scene, SelectRule rule, const CutChoice* choice,
               const BudgetState* state, CutScratch scratch, CutScratch second_scratch,
               NeedList needs, Output output) {
    await_kernel_before();
    if (state != nullptr && state->again != 0) scratch = second_scratch;
    const unsigned num_parts = *scratch.num_parts, at_once = scratch.parts_at_once(num_parts);
    const unsigned num_tickets = blocks_for(num_parts, at_once);
    if (num_tickets == 0 && blockIdx.x == 0 && threadIdx.x == 0) output.finish(0, 0);
    if (rule.budget != kNoBudget) rule.tolerance_px2 = choice->tolerance_px2;
    if (!Output::kFades) rule.fade = {};
    // If there is a block for every ticket, each block processes at most one ticket.
    const bool is_enough = num_tickets <= gridDim.x;
    if (is_enough && blockIdx.x >= num_tickets) return;
    for (unsigned ticket = take_ticket(scratch.cut_ticket); ticket < num_tickets;
         ticket = is_enough ? num_tickets : take_ticket(scratch.cut_ticket)) {
        const unsigned warp = threadIdx.x / 32, p = ticket * at_once + warp;
        LaneClusters mine{};
        if (warp < at_once && p < num_parts) mine = clusters_of_lane(scene, scene.parts[p]);
        const auto weigh = [&](const BundleOnDevice& bundle, const InstanceView& view, int32_t c) {
            const ClusterTable& table = bundle.table;
            const InstanceCut<AskedGroups> cut = cut_by_asking(table, view, rule);
            if constexpr (kTells)
                tell_need(cut, c, static_cast<uint32_t>(&bundle - scene.bundles), needs);
            return cut.drawn_weight(c);
        };
        ask_clusters<Output::kFades>(scene, rule, Tolerances::this_one, mine, weigh);
        write_clusters(mine, ticket, ticket + 1 == num_tickets, scratch.unit_state,
                       scratch.count_state, output);
    }
}

}  // namespace cuda
}  // namespace v3dg
