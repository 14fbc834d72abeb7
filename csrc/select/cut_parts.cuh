#pragma once

// The parts of a scene's tables that warps process, and the clusters of a part that one
// lane processes.

#include "base/launch.cuh"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

using Count = unsigned long long;

// Number of clusters per lane in a part of a table.
constexpr unsigned kLaneClusters = kClustersOfBounds;
constexpr unsigned kPartSize = 32 * kLaneClusters;
constexpr unsigned kCutThreads = 256, kCutWarps = kCutThreads / 32;
static_assert(kLaneClusters == 8, "a byte has one bit per cluster of a lane");
static_assert(kPartSize == kClustersOfPart, "scenes bound the number of parts");

// The work of one warp. If `lanes` is 0, the part consists of the clusters [first,
// first + kPartSize) of one instance. Otherwise, each set bit k of `lanes` assigns the
// instance at place + k to lane k, which processes its top clusters or the last
// clusters of its table.
struct CutPart {
    uint32_t place, first, lanes;
};

// Returns the index at which the last clusters of a table begin. These are the coarsest
// ones, few enough that one lane can test them.
__device__ inline uint32_t last_of_table(const ClusterTable& table) {
    return static_cast<uint32_t>(table.num_clusters() - 1) / kLaneClusters * kLaneClusters;
}

// A scene, and the data about its instances that place_kernel writes. With one
// viewpoint, the place of an instance is its index. A batch has a place for each
// instance of each camera.
struct PlacedScene {
    const BundleOnDevice* bundles;
    InstanceTable instances;
    const int32_t* bundle_of_place;
    InstanceView* views;  // written for instances whose tables are tested
    // One byte for each instance that a single lane processes. It has one bit per drawn
    // top cluster, or is 0 if the lane tests the last clusters of the table.
    uint8_t* tops;
    CutPart* parts;
};

// The state that the search for a budget's tolerance keeps for the next frame.
struct BudgetState {
    float guess = 0.0f;          // a tolerance that is probably below the next choice
    unsigned again = 0;          // nonzero if the guess was too high, so that the
                                 // second round must run
    uint32_t last_bin = kNoBin;  // state of tolerance_of_budget()
};

// A round of the search for a budget's tolerance. The first round considers tolerances
// from the guess on, and the second one all tolerances. Without a budget, there is only
// one round, and `state` is null.
struct BudgetRound {
    const BudgetState* state;
    bool is_second;

    // Returns true if the first round has found the tolerance.
    __device__ bool is_over() const { return is_second && state->again == 0; }
    __device__ float least_tolerance(const SelectRule& rule) const {
        return state == nullptr || is_second ? rule.tolerance_px2
                                             : fmaxf(rule.tolerance_px2, state->guess);
    }
};

// Enqueues one round of choosing the tolerance. Before the first round, `change` must
// have kNumBudgetBins zeros. `num_parts` is in device memory, and is set to 0 if no cut
// fits the budget.
void choose_tolerance(const PlacedScene& scene, const SelectRule& rule, const BudgetRound& round,
                      unsigned num_blocks, unsigned* num_parts, Count* change, CutChoice* choice,
                      BudgetState* state, cudaStream_t stream);

// The weights of a lane's clusters, 16 bits each, beginning at the lowest bits. Weights
// are read by shifting, because indexing an array would move it from registers to
// memory.
struct alignas(16) LaneWeights {
    uint64_t low, high;

    static __device__ LaneWeights all(int32_t weight) {
        const uint64_t four = 0x0001000100010001ull * static_cast<uint64_t>(weight);
        return {four, four};
    }
    __device__ int32_t operator[](unsigned k) const {
        return static_cast<int32_t>((k < 4 ? low : high) >> 16 * (k % 4) & 0xffff);
    }
};
static_assert(kLaneClusters == 8 && kWhole < 1 << 16, "LaneWeights holds eight weights of 16 bits");

// The clusters of a part that one lane processes. All of them belong to one instance.
// Bit k of `drawn` is set if the k-th cluster is drawn. Weights are only set in cuts
// with a fade.
struct LaneClusters {
    const BundleOnDevice* bundle;
    uint32_t place;  // place of the instance
    uint32_t first;  // index of the first cluster in the table
    // True if each lane has its own instance; false if all lanes have the same one.
    bool is_alone;
    bool are_tops;
    unsigned drawn;
    LaneWeights weights;

    __device__ int32_t cluster(unsigned k) const {
        return are_tops ? bundle->table.top_cluster[k] : static_cast<int32_t>(first + k);
    }
    // Returns the number of gaussians in `count` clusters, beginning with the k-th.
    __device__ unsigned size(unsigned k, unsigned count = 1) const {
        const int32_t c = cluster(k);
        return static_cast<unsigned>(bundle->table.offset[c + count] - bundle->table.offset[c]);
    }
    __device__ const ClusterBounds& bounds() const { return bundle->bounds[first / kLaneClusters]; }
};

// Returns the clusters that the lane processes. Clusters of a table are not tested yet.
__device__ inline LaneClusters clusters_of_lane(const PlacedScene& scene, const CutPart& part) {
    const unsigned lane = threadIdx.x % 32;
    const bool is_alone = part.lanes != 0;
    LaneClusters mine{.bundle = nullptr,
                      .place = part.place,
                      .first = part.first + kLaneClusters * lane,
                      .is_alone = is_alone,
                      .are_tops = false,
                      .drawn = 0,
                      .weights = {}};
    if (is_alone) {
        if ((part.lanes >> lane & 1) == 0) return mine;
        mine.place += lane;
        mine.drawn = scene.tops[mine.place];
        mine.are_tops = mine.drawn != 0;
        mine.weights = LaneWeights::all(kWhole);
    }
    mine.bundle = &scene.bundles[scene.bundle_of_place[mine.place]];
    if (is_alone && !mine.are_tops) mine.first = last_of_table(mine.bundle->table);
    return mine;
}

// Tests the clusters of a block's parts that come from tables. All threads of the block
// must call it. A lane is an owner if the bounds of its clusters do not exclude all of
// them. The warps share the tests of all owners, with one lane per cluster and four
// owners at a time, so that no warp waits long for another one that has more owners.
//
// Sets bit k of an owner's `drawn` if ask(bundle, view, cluster) is positive for its
// k-th cluster. With `kKeepsWeights`, it also stores the values in `weights`.
template <bool kKeepsWeights, class Ask>
__device__ void ask_clusters(const PlacedScene& scene, const SelectRule& rule,
                             Tolerances tolerances, LaneClusters& mine, const Ask& ask) {
    struct Table {
        const BundleOnDevice* bundle;  // null if each lane has a different instance
        // The first cluster or, if `bundle` is null, the place of the first lane's
        // instance.
        uint32_t first;
    };
    __shared__ InstanceView views[kCutWarps];
    __shared__ Table tables[kCutWarps];
    __shared__ unsigned num_owners[kCutWarps];
    __shared__ uint8_t owners[kCutThreads];  // indices of threads that own clusters
    __shared__ uint8_t drawn[kCutThreads];   // [thread] one bit per drawn cluster
    __shared__ LaneWeights weights[kKeepsWeights ? kCutThreads : 1];
    static_assert(kCutThreads <= 256, "`owners` stores the index of a thread in a byte");
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    bool is_owner = false;
    // The condition is equal in all lanes of the warp.
    if (!mine.is_alone && mine.bundle != nullptr) {
        const auto* view = reinterpret_cast<const uint32_t*>(scene.views + mine.place);
        for (unsigned w = lane; w < sizeof(InstanceView) / sizeof *view; w += 32)
            reinterpret_cast<uint32_t*>(views + warp)[w] = view[w];
        if (lane == 0) tables[warp] = {mine.bundle, mine.first};
    }
    if (mine.is_alone && lane == 0) tables[warp] = {nullptr, mine.place};
    __syncwarp();
    if (mine.bundle != nullptr && !mine.are_tops) {
        const ClusterTable& table = mine.bundle->table;
        const InstanceView& view = mine.is_alone ? scene.views[mine.place] : views[warp];
        is_owner = mine.first < table.num_clusters() &&
                   may_draw(table, mine.bounds(), view, rule, tolerances);
    }
    const unsigned in_warp = __ballot_sync(kAllLanes, is_owner);
    if (lane == 0) num_owners[warp] = __popc(in_warp);
    __syncthreads();
    unsigned before = 0, total = 0;
    for (unsigned w = 0; w < kCutWarps; ++w) {
        if (w < warp) before += num_owners[w];
        total += num_owners[w];
    }
    if (is_owner)
        owners[before + __popc(in_warp & ((1u << lane) - 1))] = static_cast<uint8_t>(threadIdx.x);
    __syncthreads();
    constexpr unsigned kAtOnce = 32 / kLaneClusters;
    for (unsigned first = kAtOnce * warp; first < total; first += kAtOnce * kCutWarps) {
        const unsigned place = first + lane / kLaneClusters;
        const bool is_one = place < total;
        const unsigned owner = is_one ? owners[place] : 0, k = lane % kLaneClusters;
        int32_t answer = 0;
        if (is_one) {
            const Table& of = tables[owner / 32];
            const bool is_alone = of.bundle == nullptr;
            // `lane_place` is used only if the owner's lane has its own instance.
            const uint32_t lane_place = of.first + owner % 32;
            const BundleOnDevice* bundle =
                is_alone ? &scene.bundles[scene.bundle_of_place[lane_place]] : of.bundle;
            const InstanceView& view = is_alone ? scene.views[lane_place] : views[owner / 32];
            const uint32_t c = k + (is_alone ? last_of_table(bundle->table)
                                             : of.first + kLaneClusters * (owner % 32));
            if (c < bundle->table.num_clusters())
                answer = static_cast<int32_t>(ask(*bundle, view, static_cast<int32_t>(c)));
        }
        const unsigned bits = __ballot_sync(kAllLanes, answer > 0);
        if (is_one && k == 0) drawn[owner] = static_cast<uint8_t>(bits >> lane);
        if (kKeepsWeights && is_one)
            reinterpret_cast<uint16_t*>(weights + owner)[k] = static_cast<uint16_t>(max(answer, 0));
    }
    __syncthreads();
    if (!is_owner) return;
    mine.drawn = drawn[threadIdx.x];
    if (kKeepsWeights) mine.weights = weights[threadIdx.x];
}

}  // namespace cuda
}  // namespace v3dg
