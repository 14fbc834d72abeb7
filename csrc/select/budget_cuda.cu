// Chooses the tolerance that meets a budget. change_kernel computes, for each bin, the
// difference in gaussians to the cut of the bin before (budget_math.h). choose_kernel
// then finds the smallest tolerance from which on no cut exceeds the budget.
//
// Both kernels run in two rounds. The first round only considers tolerances above half
// of the last choice, and can thus skip the tables of distant instances. The second
// round considers all tolerances. It runs only if a smaller tolerance may be the
// answer.

#include "base/scan.cuh"
#include "select/cut_parts.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kChooseThreads = 1024;
// Number of bins that a warp of choose_kernel sums.
constexpr uint32_t kWarpBins = (kNumBudgetBins + kChooseThreads - 1) / kChooseThreads * 32;
constexpr float kMostGuess = 1 << 20;

// Computes, for each bin, how many more gaussians its cut has than the cut of the bin
// before.
__global__ void change_kernel(PlacedScene scene, SelectRule rule, BudgetRound round,
                              const unsigned* num_parts, Count* change) {
    if (round.is_over()) return;
    rule.tolerance_px2 = round.least_tolerance(rule);
    __shared__ Count at_first;
    if (threadIdx.x == 0) at_first = 0;
    __syncthreads();
    const unsigned count = *num_parts;
    for (unsigned first = blockIdx.x * kCutWarps; first < count; first += gridDim.x * kCutWarps) {
        const unsigned p = first + threadIdx.x / 32;
        LaneClusters mine{};
        if (p < count) mine = clusters_of_lane(scene, scene.parts[p]);
        Count kept = 0;
        for (unsigned k = 0; k < kLaneClusters; ++k)
            if (mine.drawn >> k & 1) kept += mine.size(k);
        const auto add = [&](const BundleOnDevice& bundle, const InstanceView& view, int32_t c) {
            const ClusterTable& table = bundle.table;
            const InstanceCut<AskedGroups> cut = cut_by_asking(table, view, rule);
            const BinRange bins = cut.bins(c);
            if (bins.is_empty()) return false;
            const Count size = static_cast<Count>(table.num_gaussians(c));
            if (bins.first == 0)
                kept += size;
            else
                atomicAdd(&change[bins.first], size);
            if (bins.end < kNumBudgetBins) atomicAdd(&change[bins.end], ~size + 1);
            return true;
        };
        ask_clusters<false>(scene, rule, Tolerances::from_this_on, mine, add);
        kept = warp_sum(kept);
        if (threadIdx.x % 32 == 0 && kept > 0) atomicAdd(&at_first, kept);
    }
    __syncthreads();
    if (threadIdx.x == 0 && at_first > 0) atomicAdd(&change[0], at_first);
}

// Chooses the first bin from which on no cut exceeds the budget. With
// BudgetPace::in_steps, it may choose a later bin. If every cut exceeds the budget, it
// sets the number of parts to 0, so that cut_kernel does nothing. Launched with a
// single block.
__global__ void choose_kernel(SelectRule rule, BudgetRound round, Count* change, CutChoice* choice,
                              BudgetState* state, unsigned* num_parts) {
    if (round.is_over()) return;
    const float least_tolerance = round.least_tolerance(rule);
    __shared__ uint32_t chosen, goal;
    __shared__ Count before_warp[kChooseThreads / 32 + 1];
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const uint32_t first = kWarpBins * warp, last = min(first + kWarpBins, kNumBudgetBins);
    Count sum = 0;
    for (uint32_t bin = first + lane; bin < last; bin += 32) sum += change[bin];
    sum = warp_sum(sum);
    if (lane == 0) before_warp[warp + 1] = sum;
    if (threadIdx.x == 0) {
        before_warp[0] = 0;
        chosen = goal = 0;
    }
    __syncthreads();
    if (threadIdx.x == 0)
        for (unsigned w = 0; w < kChooseThreads / 32; ++w) before_warp[w + 1] += before_warp[w];
    __syncthreads();
    Count count = before_warp[warp];
    for (uint32_t from = first; from < last; from += 32) {
        const uint32_t bin = from + lane;
        const Count here = warp_prefix(bin < last ? change[bin] : 0);
        const Count upto = bin < last ? count + here : 0;
        const unsigned beyond = __ballot_sync(kAllLanes, upto > rule.budget),
                       beyond_goal = __ballot_sync(kAllLanes, upto > goal_of_budget(rule.budget));
        if (lane == 0 && beyond != 0)
            atomicMax(&chosen, from + 32 - __clz(static_cast<int>(beyond)));
        if (lane == 0 && beyond_goal != 0)
            atomicMax(&goal, from + 32 - __clz(static_cast<int>(beyond_goal)));
        count += __shfl_sync(kAllLanes, here, 31);
    }
    __syncthreads();
    const bool is_first_in_vain = chosen == 0 && least_tolerance > rule.tolerance_px2;
    if (is_first_in_vain)
        for (uint32_t bin = threadIdx.x; bin < kNumBudgetBins; bin += kChooseThreads)
            change[bin] = 0;
    if (threadIdx.x != 0) return;
    const bool fits_budget = chosen < kNumBudgetBins;
    const float least = fits_budget ? tolerance_of_bin(chosen, least_tolerance) : INFINITY;
    state->guess = fminf(0.5f * least, kMostGuess);
    state->again = is_first_in_vain || round.is_second;
    const bool is_chosen = fits_budget && !is_first_in_vain;
    const float tolerance =
        is_chosen ? tolerance_of_budget(rule, chosen, goal, state->last_bin) : least;
    *choice = {tolerance, !fits_budget, before_warp[kChooseThreads / 32]};
    if (!fits_budget) *num_parts = 0;
}

}  // namespace

void choose_tolerance(const PlacedScene& scene, const SelectRule& rule, const BudgetRound& round,
                      unsigned num_blocks, unsigned* num_parts, Count* change, CutChoice* choice,
                      BudgetState* state, cudaStream_t stream) {
    launch("change_kernel", change_kernel, num_blocks, kCutThreads, 0, stream, scene, rule, round,
           num_parts, change);
    launch("choose_kernel", choose_kernel, 1, kChooseThreads, 0, stream, rule, round, change,
           choice, state, num_parts);
}

}  // namespace cuda
}  // namespace v3dg
