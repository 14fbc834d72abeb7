// Two steps. place_kernel, a thread an instance: the camera in its frame, and what there is to look at:
// nothing when it is hidden, its top clusters when those are the cut, else its table. That is dealt out as
// parts: 256 clusters of a table, or the tops of up to 32 neighbouring instances. cut_kernel, a warp a part:
// which clusters are drawn, and their places in the list by a prefix sum over parts.
//
// A budget puts two kernels in between: one adds up by how much each tolerance changes the cut, one chooses.
// They take no tolerance below half of what was chosen last time, which spares them the tables of what is
// far. Where that is too much, all three run once more without it.

#include "select/select_cuda.h"

#include <algorithm>
#include <cmath>

#include "base/scan.cuh"

namespace v3dg {
namespace cuda {

// Clusters [first, first + kPartSize) of one instance's table; or where `tops` is not zero, the top clusters
// of instance + k for its bits k.
struct CutPart {
    uint32_t instance, first, tops;
};

// What is known of kEach clusters of a table, neighbours, whatever the view.
struct ClusterBounds {
    Box box;
    Ball parents, owns;  // around the centres of the balls of the groups above and of their own
    float most_parent_radius, most_parent_weight;
    float least_own_radius, least_own_weight;
    int32_t least_own_level;
    bool has_leaf, has_root;
    uint8_t alike;  // bit k: cluster k is drawn with the filter of the one before
};

// What one budget leaves for the next.
struct BudgetState {
    float guess;     // a tolerance that is likely to be too small
    unsigned again;  // whether it was too large, and the second round counts
};

namespace {

constexpr unsigned kEach = 8;  // clusters of a part that a lane looks at
constexpr unsigned kPartSize = 32 * kEach;
constexpr unsigned kCutThreads = 256, kCutWarps = kCutThreads / 32;
constexpr unsigned kCutBlocks = 4;      // on a multiprocessor
constexpr unsigned kPlaceThreads = 64;  // few, so that a few thousand instances spread over the device
constexpr unsigned kChooseThreads = 1024;
// Bins of a warp of choose_kernel.
constexpr uint32_t kChooseShare = (kNumBudgetBins + kChooseThreads - 1) / kChooseThreads * 32;
// More than rounding can do to a metric, which is compared with what bounds it.
constexpr float kBoundMargin = 1e-3f;
constexpr float kMostGuess = 1 << 20;
static_assert(kEach <= 8, "a byte says which of them are drawn, and which alike");

using Count = unsigned long long;

// Scratch of one cut, cleared before it; the states of the cut are cleared by place_kernel.
struct Scratch {
    unsigned *place_ticket, *cut_ticket;
    unsigned* num_parts;
    Count* place_state;               // a word a block of place_kernel
    Count *unit_state, *count_state;  // a word a ticket of cut_kernel
};

struct SceneOnDevice {
    const DeviceBundle* bundles;
    InstanceTable instances;
    InstanceView* views;  // of instances whose tables are looked at
    uint8_t* tops;        // of those whose tops are the cut: a bit for each that is drawn
    CutPart* parts;
};

// The tolerance that a round begins with. Without a budget there is one round and no state.
struct BudgetRound {
    const BudgetState* state;
    bool is_second;

    // Whether there is nothing to do: the first round was enough.
    __device__ bool is_over() const { return is_second && state->again == 0; }
    __device__ float tolerance(const SelectRule& rule) const {
        return state == nullptr || is_second ? rule.tolerance_px2 : fmaxf(rule.tolerance_px2, state->guess);
    }
};

enum class Look { nothing, tops, table };

__device__ Look place_instance(const SceneOnDevice& scene, size_t i, const Camera& camera,
                               const SelectRule& rule, Placement* placements) {
    const Pose pose = scene.instances.pose(i);
    if (!is_placed(pose)) return Look::nothing;
    const int32_t b = scene.instances.bundle[i];
    const ClusterTable& table = scene.bundles[b].table;
    const InstanceAxes axes = axes_of_instance(camera, pose);
    const InstanceView view =
        view_from_instance(camera, axes, pose, scene.instances.importance[i], table.pad_px);
    if (rule.culls && is_outside(table.bounds, view)) return Look::nothing;
    if (placements != nullptr)
        placements[i] = {model_view_from_instance(axes, pose), static_cast<uint32_t>(b), 0};
    if (table.top_cluster.size > kEach || !top_fits(table, view, rule)) {
        scene.views[i] = view;
        return Look::table;
    }
    unsigned drawn = 0;
    for (unsigned k = 0; k < table.top_cluster.size; ++k)
        if (!rule.culls || !is_outside(table.box[table.top_cluster[k]], view)) drawn |= 1u << k;
    scene.tops[i] = static_cast<uint8_t>(drawn);
    return drawn != 0 ? Look::tops : Look::nothing;
}

__global__ void place_kernel(SceneOnDevice scene, Camera camera, SelectRule rule, FrameImage image,
                             FrameImage* images, Placement* placements, BudgetRound round, Scratch scratch) {
    if (round.is_over()) return;
    rule.tolerance_px2 = round.tolerance(rule);
    const size_t block = take_ticket(scratch.place_ticket), i = block * kPlaceThreads + threadIdx.x;
    if (i == 0 && images != nullptr) images[0] = image;
    const size_t num_instances = scene.instances.scale.size;
    const Look look = i < num_instances ? place_instance(scene, i, camera, rule, placements) : Look::nothing;

    // Tops of neighbours, with no table in between, make one part. The first of them deals it out.
    const unsigned lane = threadIdx.x % 32, below = (1u << lane) - 1;
    const unsigned tops = __ballot_sync(kAllLanes, look == Look::tops);
    const unsigned tables = __ballot_sync(kAllLanes, look == Look::table);
    const unsigned table_below = tables & below, table_above = tables & ~below;
    const unsigned from = table_below != 0 ? 32 - __clz(static_cast<int>(table_below)) : 0;
    const unsigned to = table_above != 0 ? __ffs(table_above) - 1 : 32;
    const bool begins = look == Look::tops && (tops & below) >> from == 0;
    unsigned parts = begins ? 1 : 0;
    if (look == Look::table)
        parts = blocks_for(scene.bundles[scene.instances.bundle[i]].table.own_group.size, kPartSize);

    unsigned total;
    const unsigned before_in_block = block_prefix(parts, total);
    __shared__ unsigned before_block;
    if (threadIdx.x < 32) {
        const unsigned before = static_cast<unsigned>(prefix_of_part(scratch.place_state, block, total));
        if (threadIdx.x == 0) before_block = before;
    }
    __syncthreads();
    const unsigned before = before_block;
    CutPart* part = scene.parts + before + before_in_block;
    if (begins) {
        const unsigned until = to < 32 ? (1u << to) - 1 : kAllLanes;
        *part = {static_cast<uint32_t>(i), 0, (tops & until) >> lane};
    } else {
        for (unsigned p = 0; p < parts; ++p) part[p] = {static_cast<uint32_t>(i), p * kPartSize, 0};
    }
    // Those tickets whose first part is one of the block's.
    for (unsigned t = blocks_for(before, kCutWarps) + threadIdx.x; t < blocks_for(before + total, kCutWarps);
         t += kPlaceThreads)
        scratch.unit_state[t] = scratch.count_state[t] = 0;
    if (block + 1 == gridDim.x && threadIdx.x == 0) *scratch.num_parts = before + total;
}

// What a lane has of a part: clusters of one instance, and a bit for each that is drawn.
struct LaneClusters {
    const DeviceBundle* bundle;
    uint32_t instance;
    uint32_t first;  // of a table
    bool are_tops;
    unsigned drawn;

    __device__ int32_t cluster(unsigned k) const {
        return are_tops ? bundle->table.top_cluster[k] : static_cast<int32_t>(first + k);
    }
    __device__ unsigned size(unsigned k, unsigned count = 1) const {
        const int32_t c = cluster(k);
        return static_cast<unsigned>(bundle->table.offset[c + count] - bundle->table.offset[c]);
    }
};

// Without `drawn` where it is a table that is looked at.
__device__ LaneClusters clusters_of_lane(const SceneOnDevice& scene, const CutPart& part) {
    const unsigned lane = threadIdx.x % 32;
    LaneClusters mine{nullptr, part.instance, part.first + kEach * lane, part.tops != 0, 0};
    if (mine.are_tops) {
        if ((part.tops >> lane & 1) == 0) return mine;
        mine.instance += lane;
        mine.drawn = scene.tops[mine.instance];
    }
    mine.bundle = &scene.bundles[scene.instances.bundle[mine.instance]];
    return mine;
}

// Whether all the groups above the clusters fit, so that none is drawn.
__device__ bool parents_fit(const ClusterBounds& bounds, const InstanceView& view, const SelectRule& rule) {
    if (bounds.has_root || rule.footprint == Footprint::paper) return false;
    const float distance = sqrtf(distance2_to(bounds.parents, view)) - bounds.parents.radius;
    return distance > 0.0f &&
           footprint_at(bounds.most_parent_radius, distance * distance, view) * bounds.most_parent_weight <=
               (1.0f - kBoundMargin) * rule.tolerance_px2;
}

// Whether none of the clusters has a group of its own that fits.
__device__ bool owns_do_not_fit(const ClusterBounds& bounds, const InstanceView& view,
                                const SelectRule& rule) {
    if (bounds.has_leaf || bounds.least_own_level <= rule.min_level || rule.footprint == Footprint::paper)
        return false;
    const float distance = sqrtf(distance2_to(bounds.owns, view)) + bounds.owns.radius;
    return footprint_at(bounds.least_own_radius, distance * distance, view) * bounds.least_own_weight >
           (1.0f + kBoundMargin) * rule.tolerance_px2;
}

// Calls visit(cluster) for clusters of a part of a table, a lane a cluster: for those of each lane that is
// `active`, four lanes' at a time. Returns to each lane a bit for each of its own where that returned true.
template <class Visit>
__device__ unsigned visit_clusters(const LaneClusters& mine, bool active, const Visit& visit) {
    const unsigned lane = threadIdx.x % 32;
    const uint32_t part_first = mine.first - kEach * lane;
    unsigned todo = __ballot_sync(kAllLanes, active), found = 0;
    while (todo != 0) {
        unsigned owners = 0, owner = 32;  // in bytes; of this lane
        for (unsigned at = 0; at < 32; at += kEach) {
            const unsigned next = todo != 0 ? __ffs(todo) - 1 : 32;
            todo &= todo - 1;
            owners |= next << at;
            if (lane / kEach == at / kEach) owner = next;
        }
        const uint32_t c = part_first + kEach * owner + lane % kEach;
        const bool is_one = owner < 32 && c < mine.bundle->table.own_group.size;
        const unsigned bits = __ballot_sync(kAllLanes, is_one && visit(static_cast<int32_t>(c)));
        for (unsigned at = 0; at < 32; at += kEach)
            if ((owners >> at & 255) == lane) found = bits >> at & 255;
    }
    return found;
}

// Whether some of the lane's clusters may be drawn, at this tolerance or, if `coarser` are asked for, a
// higher.
__device__ bool may_draw(const LaneClusters& mine, const InstanceView& view, const SelectRule& rule,
                         bool coarser) {
    if (mine.first >= mine.bundle->table.own_group.size) return false;
    const ClusterBounds& bounds = mine.bundle->bounds[mine.first / kEach];
    return !(rule.culls && is_outside(bounds.box, view)) && !parents_fit(bounds, view, rule) &&
           (coarser || !owns_do_not_fit(bounds, view, rule));
}

__device__ unsigned drawn_of_table(const SceneOnDevice& scene, const LaneClusters& mine,
                                   const SelectRule& rule) {
    const ClusterTable& table = mine.bundle->table;
    const InstanceView view = scene.views[mine.instance];
    return visit_clusters(mine, may_draw(mine, view, rule, false), [&](int32_t c) {
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        const bool own_fits = own < 0 || fits(table, own, view, rule);
        const bool parent_fits = parent >= 0 && fits(table, parent, view, rule);
        return own_fits && !parent_fits && !(rule.culls && is_outside(table.box[c], view));
    });
}

// Adds to `change` what count_instance of the CPU's half does.
__global__ void change_kernel(SceneOnDevice scene, SelectRule rule, BudgetRound round,
                              const unsigned* num_parts, Count* change) {
    if (round.is_over()) return;
    rule.tolerance_px2 = round.tolerance(rule);
    __shared__ Count at_first;
    if (threadIdx.x == 0) at_first = 0;
    __syncthreads();
    for (unsigned p = blockIdx.x * kCutWarps + threadIdx.x / 32; p < *num_parts; p += gridDim.x * kCutWarps) {
        const LaneClusters mine = clusters_of_lane(scene, scene.parts[p]);
        Count kept = 0;
        if (mine.are_tops) {
            for (unsigned k = 0; k < kEach; ++k)
                if (mine.drawn >> k & 1) kept += mine.size(k);
        } else {
            const ClusterTable& table = mine.bundle->table;
            const InstanceView view = scene.views[mine.instance];
            visit_clusters(mine, may_draw(mine, view, rule, true), [&](int32_t c) {
                const int32_t own = table.own_group[c], parent = table.parent_group[c];
                const uint32_t first = own < 0 ? 0 : bin_of_group(table, own, view, rule),
                               last = parent < 0 ? kNumBudgetBins : bin_of_group(table, parent, view, rule);
                if (first >= last || (rule.culls && is_outside(table.box[c], view))) return false;
                const Count size = static_cast<Count>(table.offset[c + 1] - table.offset[c]);
                if (first == 0)
                    kept += size;
                else
                    atomicAdd(&change[first], size);
                if (last < kNumBudgetBins) atomicAdd(&change[last], ~size + 1);
                return true;
            });
        }
        kept = warp_sum(kept);
        if (threadIdx.x % 32 == 0 && kept > 0) atomicAdd(&at_first, kept);
    }
    __syncthreads();
    if (threadIdx.x == 0 && at_first > 0) atomicAdd(&change[0], at_first);
}

// One block. The tolerance after the last whose cut exceeds the budget; where there is none, nothing is left
// to cut.
__global__ void choose_kernel(SelectRule rule, BudgetRound round, Count* change, CutChoice* choice,
                              BudgetState* state, unsigned* num_parts) {
    if (round.is_over()) return;
    const float least_tolerance = round.tolerance(rule);
    __shared__ uint32_t chosen;
    __shared__ Count before_warp[kChooseThreads / 32 + 1];
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const uint32_t first = kChooseShare * warp, last = min(first + kChooseShare, kNumBudgetBins);
    Count sum = 0;
    for (uint32_t bin = first + lane; bin < last; bin += 32) sum += change[bin];
    sum = warp_sum(sum);
    if (lane == 0) before_warp[warp + 1] = sum;
    if (threadIdx.x == 0) {
        before_warp[0] = 0;
        chosen = 0;
    }
    __syncthreads();
    if (threadIdx.x == 0)
        for (unsigned w = 0; w < kChooseThreads / 32; ++w) before_warp[w + 1] += before_warp[w];
    __syncthreads();
    Count count = before_warp[warp];
    for (uint32_t from = first; from < last; from += 32) {
        const uint32_t bin = from + lane;
        Count here = bin < last ? change[bin] : 0;
#pragma unroll
        for (unsigned offset = 1; offset < 32; offset *= 2) {
            const Count below = __shfl_up_sync(kAllLanes, here, offset);
            if (lane >= offset) here += below;
        }
        const unsigned beyond = __ballot_sync(kAllLanes, bin < last && count + here > rule.budget);
        if (lane == 0 && beyond != 0) atomicMax(&chosen, from + 32 - __clz(static_cast<int>(beyond)));
        count += __shfl_sync(kAllLanes, here, 31);
    }
    __syncthreads();
    const bool is_first_in_vain = chosen == 0 && least_tolerance > rule.tolerance_px2;
    if (is_first_in_vain)
        for (uint32_t bin = threadIdx.x; bin < kNumBudgetBins; bin += kChooseThreads) change[bin] = 0;
    if (threadIdx.x != 0) return;
    const bool fits_budget = chosen < kNumBudgetBins;
    const float tolerance = fits_budget ? tolerance_of_bin(chosen, least_tolerance) : INFINITY;
    *choice = {tolerance, !fits_budget, before_warp[kChooseThreads / 32]};
    *state = {fminf(0.5f * tolerance, kMostGuess), is_first_in_vain || round.is_second};
    if (!fits_budget) *num_parts = 0;
}

// What a lane writes of its warp's clusters.
struct Share {
    unsigned units, gaussians;  // units: elements of the list
};

// Selected clusters as (instance, cluster).
struct PairOutput {
    int32_t *instance, *cluster;
    Count capacity;
    Count *pairs, *gaussians;

    __device__ Share share(const LaneClusters& mine) const {
        Share share{0, 0};
        for (unsigned k = 0; k < kEach; ++k)
            if (mine.drawn >> k & 1) {
                ++share.units;
                share.gaussians += mine.size(k);
            }
        return share;
    }
    __device__ void write(const LaneClusters& mine, Count first, Count) const {
        for (unsigned k = 0; k < kEach; ++k)
            if (mine.drawn >> k & 1) {
                if (first >= capacity) return;
                instance[first] = static_cast<int32_t>(mine.instance);
                cluster[first++] = mine.cluster(k);
            }
    }
    __device__ void finish(Count units, Count gaussians_drawn) const {
        *pairs = units;
        *gaussians = gaussians_drawn;
    }
};

// Neighbouring clusters that are drawn alike, for the lane's instance; or one that is drawn for all instances
// of `sharers`, bits above the first of the part.
struct DrawnRun {
    unsigned k, num_clusters;
    uint32_t sharers;
    unsigned num_instances;

    __device__ unsigned gaussians_an_item() const { return kItemSize / num_instances; }
};

// Whether a warp is quicker with a cluster's gaussians one by one, each for all its instances at once, than
// with the instances one by one. An item takes as long as two more rounds.
__device__ bool is_worth_sharing(unsigned num_gaussians, unsigned num_instances) {
    return num_instances > 1 && num_gaussians <= num_instances * (blocks_for(num_gaussians, 32) + 2);
}

// Calls visit(DrawnRun) in the lane that writes it; for whole warps.
template <class Visit>
__device__ void for_each_drawn(const LaneClusters& mine, const Visit& visit) {
    if (!mine.are_tops) {
        if (mine.drawn == 0) return;
        const unsigned alike = mine.bundle->bounds[mine.first / kEach].alike;
        for (unsigned k = 0, end; k < kEach; k = end) {
            end = k + 1;
            if ((mine.drawn >> k & 1) == 0) continue;
            while ((mine.drawn & alike) >> end & 1) ++end;
            visit(DrawnRun{k, end - k, 0, 1});
        }
        return;
    }
    const unsigned same_bundle =
        __match_any_sync(kAllLanes, reinterpret_cast<unsigned long long>(mine.bundle));
    for (unsigned k = 0; __any_sync(kAllLanes, mine.drawn >> k != 0); ++k) {
        const bool is_drawn = (mine.drawn >> k & 1) != 0;
        const unsigned sharers = __ballot_sync(kAllLanes, is_drawn) & same_bundle, count = __popc(sharers);
        if (!is_drawn) continue;
        if (!is_worth_sharing(mine.size(k), count))
            visit(DrawnRun{k, 1, 0, 1});
        else if (threadIdx.x % 32 + 1 == static_cast<unsigned>(__ffs(sharers)))
            visit(DrawnRun{k, 1, sharers, count});
    }
}

// Selected clusters as items, neighbours together; the tops of neighbouring instances share theirs.
struct ItemOutput {
    ItemList items;

    __device__ Share share(const LaneClusters& mine) const {
        Share share{0, 0};
        for_each_drawn(mine, [&](const DrawnRun& run) {
            const unsigned size = mine.size(run.k, run.num_clusters);
            share.units += blocks_for(size, run.gaussians_an_item());
            share.gaussians += run.num_instances * size;
        });
        return share;
    }
    __device__ void write(const LaneClusters& mine, Count first, Count record) const {
        for_each_drawn(mine, [&](const DrawnRun& run) {
            const int32_t cluster = mine.cluster(run.k);
            const unsigned size = mine.size(run.k, run.num_clusters), step = run.gaussians_an_item();
            const uint32_t placement = run.sharers == 0 ? mine.instance : mine.instance - threadIdx.x % 32;
            const uint32_t gaussian = static_cast<uint32_t>(mine.bundle->table.offset[cluster]);
            const float filter_px2 = mine.bundle->filters.filter_px2[cluster];
            const uint32_t compensate = mine.bundle->filters.compensate[cluster];
            for (unsigned skip = 0; skip < size; skip += step, ++first) {
                const unsigned count = min(step, size - skip);
                if (first < items.item_capacity &&
                    record + run.num_instances * count <= items.record_capacity)
                    items.items[first] = {
                        placement,  gaussian + skip, count,      static_cast<uint32_t>(record),
                        filter_px2, compensate,      run.sharers};
                record += run.num_instances * count;
            }
        });
    }
    __device__ void finish(Count units, Count gaussians) const {
        items.counters->items = units;
        items.counters->gaussians = gaussians;
    }
};

// The block's share of ticket `ticket` of a list, each thread with the clusters that it draws.
template <class Output>
__device__ void write_clusters(const LaneClusters& mine, unsigned ticket, bool is_last, Count* unit_state,
                               Count* count_state, const Output& output) {
    __shared__ Count before_units, before_gaussians;
    const Share share = output.share(mine);
    unsigned num_units, num_gaussians;
    const unsigned units_before = block_prefix(share.units, num_units),
                   gaussians_before = block_prefix(share.gaussians, num_gaussians);
    if (threadIdx.x < 64) {  // a warp each
        const bool is_units = threadIdx.x < 32;
        const Count before =
            prefix_of_part(is_units ? unit_state : count_state, ticket, is_units ? num_units : num_gaussians);
        if (threadIdx.x % 32 == 0) (is_units ? before_units : before_gaussians) = before;
    }
    __syncthreads();
    output.write(mine, before_units + units_before, before_gaussians + gaussians_before);
    if (is_last && threadIdx.x == 0)
        output.finish(before_units + num_units, before_gaussians + num_gaussians);
}

template <class Output>
__global__ void __launch_bounds__(kCutThreads, kCutBlocks)
    cut_kernel(SceneOnDevice scene, SelectRule rule, const CutChoice* choice, const BudgetState* state,
               Scratch scratch, Scratch second_scratch, Output output) {
    if (state != nullptr && state->again != 0) scratch = second_scratch;
    const unsigned num_parts = *scratch.num_parts, num_tickets = blocks_for(num_parts, kCutWarps);
    if (num_tickets == 0 && blockIdx.x == 0 && threadIdx.x == 0) output.finish(0, 0);
    if (rule.budget != kNoBudget) rule.tolerance_px2 = choice->tolerance_px2;
    for (unsigned ticket = take_ticket(scratch.cut_ticket); ticket < num_tickets;
         ticket = take_ticket(scratch.cut_ticket)) {
        const unsigned p = ticket * kCutWarps + threadIdx.x / 32;
        LaneClusters mine{};
        if (p < num_parts) {
            mine = clusters_of_lane(scene, scene.parts[p]);
            if (!mine.are_tops) mine.drawn = drawn_of_table(scene, mine, rule);
        }
        write_clusters(mine, ticket, ticket + 1 == num_tickets, scratch.unit_state, scratch.count_state,
                       output);
    }
}

// A thread an instance.
__global__ void place_all_kernel(SceneOnDevice scene, Camera camera, FrameImage image, FrameImage* images,
                                 Placement* placements) {
    const size_t i = size_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i == 0) images[0] = image;
    if (i >= scene.instances.scale.size) return;
    const Pose pose = scene.instances.pose(i);
    placements[i] = {model_view_from_instance(axes_of_instance(camera, pose), pose),
                     static_cast<uint32_t>(scene.instances.bundle[i]), 0};
}

// A thread kEach pairs. The pairs of instances without a pose are left out.
__global__ void __launch_bounds__(kCutThreads)
    given_kernel(SceneOnDevice scene, Span<const int32_t> instance, Span<const int32_t> cluster,
                 Scratch scratch, ItemOutput output) {
    const unsigned ticket = take_ticket(scratch.cut_ticket);
    const size_t p = size_t(ticket) * kCutThreads + threadIdx.x;
    LaneClusters mine{};
    if (p < instance.size && is_placed(scene.instances.pose(instance[p])))
        mine = {&scene.bundles[scene.instances.bundle[instance[p]]], static_cast<uint32_t>(instance[p]),
                static_cast<uint32_t>(cluster[p]), false, 1};
    write_clusters(mine, ticket, ticket + 1 == gridDim.x, scratch.unit_state, scratch.count_state, output);
}

// At least one: an empty scene has a picture, too.
unsigned place_blocks(size_t num_instances) { return std::max(1u, blocks_for(num_instances, kPlaceThreads)); }

// Words of Scratch before the states of the cut: three counters and the states of place_kernel's blocks.
size_t cleared_words(size_t num_instances) { return 2 + place_blocks(num_instances); }

size_t scratch_words(size_t num_instances, size_t num_tickets) {
    return cleared_words(num_instances) + 2 * num_tickets;
}

Scratch scratch_in(Count* words, size_t num_instances, size_t num_tickets) {
    auto* counters = reinterpret_cast<unsigned*>(words);
    Count* states = words + cleared_words(num_instances);
    return {counters, counters + 1, counters + 2, words + 2, states, states + num_tickets};
}

// Around the centres of balls.
class CenterBounds {
  public:
    void add(const Ball& ball) { centers_.push_back(ball); }
    Ball ball() const {
        double middle[3] = {0, 0, 0}, radius2 = 0;
        for (const Ball& b : centers_) {
            const float center[3] = {b.x, b.y, b.z};
            for (int a = 0; a < 3; ++a) middle[a] += center[a] / static_cast<double>(centers_.size());
        }
        const float m[3] = {float(middle[0]), float(middle[1]), float(middle[2])};
        for (const Ball& b : centers_) {
            const double d[3] = {double(b.x) - m[0], double(b.y) - m[1], double(b.z) - m[2]};
            radius2 = std::max(radius2, d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
        }
        return {m[0], m[1], m[2], static_cast<float>(std::sqrt(radius2) * (1 + 1e-6))};
    }

  private:
    std::vector<Ball> centers_;
};

ClusterBounds bounds_of(const ClusterTable& table, const ClusterFilters& filters, size_t first, size_t last) {
    ClusterBounds part{no_box(), {}, {}, 0, 0, INFINITY, INFINITY, INT32_MAX, false, false, 0};
    CenterBounds parents, owns;
    for (size_t c = first; c < last; ++c) {
        if (c > first && filters.filter_px2[c] == filters.filter_px2[c - 1] &&
            filters.compensate[c] == filters.compensate[c - 1])
            part.alike |= 1 << (c - first);
        grow(part.box, table.box[c]);
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        part.has_leaf |= own < 0;
        part.has_root |= parent < 0;
        if (own >= 0) {
            owns.add(table.ball[own]);
            part.least_own_radius = std::min(part.least_own_radius, table.ball[own].radius);
            part.least_own_weight = std::min(part.least_own_weight, table.weight[own]);
            part.least_own_level = std::min(part.least_own_level, table.level[own]);
        }
        if (parent >= 0) {
            parents.add(table.ball[parent]);
            part.most_parent_radius = std::max(part.most_parent_radius, table.ball[parent].radius);
            part.most_parent_weight = std::max(part.most_parent_weight, table.weight[parent]);
        }
    }
    part.parents = parents.ball();
    part.owns = owns.ball();
    return part;
}

std::vector<ClusterBounds> bounds_of(const ClusterTable& table, const ClusterFilters& filters) {
    std::vector<ClusterBounds> bounds;
    for (size_t first = 0; first < table.own_group.size; first += kEach)
        bounds.push_back(bounds_of(table, filters, first, std::min(first + kEach, table.own_group.size)));
    return bounds;
}

template <class T>
void copy_to_host(T* to, const T* from, size_t count, cudaStream_t stream) {
    if (count > 0)
        check(cudaMemcpyAsync(to, from, count * sizeof(T), cudaMemcpyDeviceToHost, stream),
              "cudaMemcpyAsync to the host");
}

}  // namespace

SceneTables::SceneTables(Span<const ClusterTable> tables, Span<const ClusterFilters> filters,
                         cudaStream_t stream) {
    const auto upload = [&](auto host) {
        using T = std::remove_const_t<std::remove_reference_t<decltype(host[0])>>;
        storage_.emplace_back(Span<const unsigned char>{reinterpret_cast<const unsigned char*>(host.data),
                                                        host.size * sizeof(T)},
                              stream);
        return Span<const T>{reinterpret_cast<const T*>(storage_.back().data()), host.size};
    };
    std::vector<DeviceBundle> bundles(tables.size);
    for (size_t b = 0; b < tables.size; ++b) {
        ClusterTable& table = bundles[b].table;
        table = tables[b];
        table.ball = upload(table.ball);
        table.weight = upload(table.weight);
        table.level = upload(table.level);
        table.own_group = upload(table.own_group);
        table.parent_group = upload(table.parent_group);
        table.box = upload(table.box);
        table.offset = upload(table.offset);
        table.top_group = upload(table.top_group);
        table.top_cluster = upload(table.top_cluster);
        const std::vector<ClusterBounds> bounds = bounds_of(tables[b], filters[b]);
        bundles[b].bounds = upload(Span<const ClusterBounds>{bounds.data(), bounds.size()}).data;
        bundles[b].filters = {upload(filters[b].filter_px2), upload(filters[b].compensate)};
        num_clusters_.push_back(table.own_group.size);
    }
    bundles_.copy_from({bundles.data(), bundles.size()}, stream);
    const BudgetState none{};
    budget_.copy_from({&none, 1}, stream);
}

void SceneTables::set_instances(Span<const int32_t> bundle, Span<const float> importance,
                                cudaStream_t stream) {
    const Turn turn(turns_, stream);
    const size_t count = bundle.size;
    num_instances_ = count;
    most_parts_ = 0;
    for (const int32_t b : bundle) most_parts_ += std::max(1u, blocks_for(num_clusters_[b], kPartSize));
    bundle_.copy_from(bundle, stream);
    importance_.copy_from(importance, stream);
    views_.reserve(count, stream);
    tops_.reserve(count, stream);
    parts_.reserve(most_parts_, stream);
    scratch_.reserve(2 * scratch_words(count, blocks_for(most_parts_, kCutWarps)), stream);
}

void SceneTables::set_poses(const PoseSpan& position, const PoseSpan& quaternion, const PoseSpan& scale,
                            cudaStream_t stream) {
    const Turn turn(turns_, stream);
    const auto take = [&](const PoseSpan& from, int k) {
        return from.is_on_device ? from.values.data : uploaded_[k].copy_from(from.values, stream);
    };
    position_ = take(position, 0);
    quaternion_ = take(quaternion, 1);
    scale_ = take(scale, 2);
}

InstanceTable SceneTables::instances() const {
    const size_t count = num_instances();
    return {{bundle_.data(), count},
            {position_, 3 * count},
            {quaternion_, 4 * count},
            {scale_, count},
            {importance_.data(), count}};
}

template <class Output>
void SceneTables::cut(const Camera& camera, const SelectRule& rule, const FrameImage* image,
                      FrameImage* images, Placement* placements, CutChoice* choice, const Output& output,
                      cudaStream_t stream) {
    const size_t count = num_instances(), num_tickets = blocks_for(most_parts_, kCutWarps);
    Count* words = scratch_.data();
    const Scratch scratches[2] = {scratch_in(words, count, num_tickets),
                                  scratch_in(words + scratch_words(count, num_tickets), count, num_tickets)};
    const SceneOnDevice scene{bundles_.data(), instances(), views_.data(), tops_.data(), parts_.data()};
    const unsigned blocks = static_cast<unsigned>(
        std::clamp<size_t>(num_tickets, 1, (2048 / kCutThreads) * num_multiprocessors()));
    const bool has_budget = rule.budget != kNoBudget;
    BudgetState* state = has_budget ? budget_.data() : nullptr;
    Count* change = has_budget ? change_.reserve(kNumBudgetBins, stream) : nullptr;
    if (has_budget)
        check(cudaMemsetAsync(change, 0, kNumBudgetBins * sizeof(Count), stream), "cudaMemsetAsync");
    for (const bool is_second : {false, true}) {
        const Scratch& scratch = scratches[is_second];
        const BudgetRound round{state, is_second};
        check(cudaMemsetAsync(scratch.place_ticket, 0, cleared_words(count) * sizeof(Count), stream),
              "cudaMemsetAsync");
        launch("place_kernel", place_kernel, place_blocks(count), kPlaceThreads, 0, stream, scene, camera,
               rule, image == nullptr ? FrameImage{} : *image, images, placements, round, scratch);
        if (!has_budget) break;
        launch("change_kernel", change_kernel, blocks, kCutThreads, 0, stream, scene, rule, round,
               scratch.num_parts, change);
        launch("choose_kernel", choose_kernel, 1, kChooseThreads, 0, stream, rule, round, change, choice,
               state, scratch.num_parts);
    }
    launch("cut_kernel", cut_kernel<Output>, blocks, kCutThreads, 0, stream, scene, rule, choice, state,
           scratches[0], scratches[1], output);
}

void SceneTables::cut_items(const Camera& camera, const SelectRule& rule, const FrameImage& image,
                            FrameImage* images, Placement* placements, const ItemList& items,
                            cudaStream_t stream) {
    const Turn turn(turns_, stream);
    cut(camera, rule, &image, images, placements, &items.counters->choice, ItemOutput{items}, stream);
}

void SceneTables::given_items(const Camera& camera, Span<const int32_t> instance, Span<const int32_t> cluster,
                              const FrameImage& image, FrameImage* images, Placement* placements,
                              const ItemList& items, cudaStream_t stream) {
    const Turn turn(turns_, stream);
    const SceneOnDevice scene{bundles_.data(), instances(), nullptr, nullptr, nullptr};
    const unsigned blocks = std::max(1u, blocks_for(instance.size, kCutThreads));
    const size_t words = scratch_words(0, blocks);
    const Scratch scratch = scratch_in(scratch_.reserve(words, stream), 0, blocks);
    check(cudaMemsetAsync(scratch_.data(), 0, words * sizeof(Count), stream), "cudaMemsetAsync");
    launch("place_all_kernel", place_all_kernel, place_blocks(num_instances()), kPlaceThreads, 0, stream,
           scene, camera, image, images, placements);
    launch("given_kernel", given_kernel, blocks, kCutThreads, 0, stream, scene, instance, cluster, scratch,
           ItemOutput{items});
}

void SceneTables::select(const Camera& camera, const SelectRule& rule, SelectOutput& out,
                         cudaStream_t stream) {
    const Turn turn(turns_, stream);
    Pairs* on_device = pairs_.reserve(1, stream);
    Pairs counts{};
    // Most cuts of most scenes fit at once.
    for (Count capacity = std::max<Count>(1u << 16, pair_instance_.capacity());; capacity = counts.pairs) {
        const PairOutput output{pair_instance_.reserve(capacity, stream),
                                pair_cluster_.reserve(capacity, stream), capacity, &on_device->pairs,
                                &on_device->gaussians};
        check(cudaMemsetAsync(on_device, 0, sizeof *on_device, stream), "cudaMemsetAsync");
        cut(camera, rule, nullptr, nullptr, nullptr, &on_device->choice, output, stream);
        copy_to_host(&counts, on_device, 1, stream);
        check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
        if (counts.pairs <= capacity) break;
    }
    const bool has_budget = rule.budget != kNoBudget;
    out.fits_budget = !has_budget || !counts.choice.exceeds_budget;
    out.tolerance_px2 = has_budget ? counts.choice.tolerance_px2 : rule.tolerance_px2;
    out.num_gaussians = static_cast<int64_t>(out.fits_budget ? counts.gaussians : counts.choice.least);
    out.instance.resize(counts.pairs);
    out.cluster.resize(counts.pairs);
    copy_to_host(out.instance.data(), pair_instance_.data(), counts.pairs, stream);
    copy_to_host(out.cluster.data(), pair_cluster_.data(), counts.pairs, stream);
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

}  // namespace cuda
}  // namespace v3dg
