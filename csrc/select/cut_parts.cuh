#pragma once

// A scene's tables in parts that warps work on, and the clusters that a lane has of a part.

#include "base/launch.cuh"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

using Count = unsigned long long;

constexpr unsigned kLaneClusters = kClustersOfBounds;  // of a part of a table
constexpr unsigned kPartSize = 32 * kLaneClusters;
constexpr unsigned kCutThreads = 256, kCutWarps = kCutThreads / 32;
static_assert(kLaneClusters == 8, "a byte says which of them are drawn");

// Clusters [first, first + kPartSize) of one instance's table; or where `tops` is not zero, the top clusters
// of instance + k for its bits k.
struct CutPart {
    uint32_t instance, first, tops;
};

// A scene and what place_kernel finds out about its instances.
struct PlacedScene {
    const BundleOnDevice* bundles;
    InstanceTable instances;
    InstanceView* views;  // of instances whose tables are asked
    uint8_t* tops;        // of those whose tops are the cut: a bit for each that is drawn
    CutPart* parts;
};

// What the search for the tolerance of a budget hands to the next one.
struct BudgetState {
    float guess = 0.0f;          // a tolerance that is probably below the one that will be chosen
    unsigned again = 0;          // whether it was above, so that the second round counts
    uint32_t last_bin = kNoBin;  // as tolerance_of_budget() keeps it
};

// One search for the tolerance of a budget: the first round looks at no tolerance below the guess, the second
// at all. Without a budget there is one round, and no state.
struct BudgetRound {
    const BudgetState* state;
    bool is_second;

    // Whether there is nothing to do, because the first round was enough.
    __device__ bool is_over() const { return is_second && state->again == 0; }
    __device__ float least_tolerance(const SelectRule& rule) const {
        return state == nullptr || is_second ? rule.tolerance_px2 : fmaxf(rule.tolerance_px2, state->guess);
    }
};

// Enqueues the choice of the tolerance. `change`: kNumBudgetBins zeros before the first round. num_parts: on
// the device; becomes 0 where no cut fits the budget.
void choose_tolerance(const PlacedScene& scene, const SelectRule& rule, const BudgetRound& round,
                      unsigned num_blocks, unsigned* num_parts, Count* change, CutChoice* choice,
                      BudgetState* state, cudaStream_t stream);

// Weights of a lane's clusters, kWhole or less each. The lane picks one by shifting, for an index would put
// them into memory.
struct LaneWeights {
    uint64_t low, high;

    static __device__ LaneWeights all(int32_t weight) {
        const uint64_t four = 0x0001000100010001ull * static_cast<uint64_t>(weight);
        return {four, four};
    }
    __device__ int32_t operator[](unsigned k) const {
        return static_cast<int32_t>((k < 4 ? low : high) >> 16 * (k % 4) & 0xffff);
    }
};
static_assert(kLaneClusters == 8 && kWhole < 1 << 16, "two words hold the weights of a lane");

// What a lane has of a part: clusters of one instance, and a bit for each that is drawn. Weights are of cuts
// with a fade alone.
struct LaneClusters {
    const BundleOnDevice* bundle;
    uint32_t instance;
    uint32_t first;  // of a table
    bool are_tops;
    unsigned drawn;
    LaneWeights weights;

    __device__ int32_t cluster(unsigned k) const {
        return are_tops ? bundle->table.top_cluster[k] : static_cast<int32_t>(first + k);
    }
    // Gaussians of `count` neighbours from the k-th cluster on.
    __device__ unsigned size(unsigned k, unsigned count = 1) const {
        const int32_t c = cluster(k);
        return static_cast<unsigned>(bundle->table.offset[c + count] - bundle->table.offset[c]);
    }
    __device__ const ClusterBounds& bounds() const { return bundle->bounds[first / kLaneClusters]; }
};

// Those of a table are not asked yet.
__device__ inline LaneClusters clusters_of_lane(const PlacedScene& scene, const CutPart& part) {
    const unsigned lane = threadIdx.x % 32;
    LaneClusters mine{nullptr, part.instance, part.first + kLaneClusters * lane, part.tops != 0, 0, {}};
    if (mine.are_tops) {
        if ((part.tops >> lane & 1) == 0) return mine;
        mine.instance += lane;
        mine.drawn = scene.tops[mine.instance];
        mine.weights = LaneWeights::all(kWhole);
    }
    mine.bundle = &scene.bundles[scene.instances.bundle[mine.instance]];
    return mine;
}

// Hands the answers of the kLaneClusters lanes from `from` on to this lane, unless that is 32.
__device__ inline void keep_weights(int32_t answer, unsigned from, LaneWeights& weights) {
    LaneWeights found{};
#pragma unroll
    for (unsigned k = 0; k < kLaneClusters; ++k) {
        const uint64_t weight = __shfl_sync(kAllLanes, max(answer, 0), (from + k) % 32);
        (k < 4 ? found.low : found.high) |= weight << 16 * (k % 4);
    }
    if (from < 32) weights = found;
}

// Asks the clusters of a part of a table, a lane a cluster, for the lanes whose bounds do not tell that none
// of theirs is drawn; four such lanes at a time. Returns to each lane a bit for each of its own clusters for
// which ask(cluster) was positive, and keeps what it was where `weights` is not null.
template <class Ask>
__device__ unsigned ask_clusters(const LaneClusters& mine, const InstanceView& view, const SelectRule& rule,
                                 Tolerances tolerances, const Ask& ask, LaneWeights* weights = nullptr) {
    const unsigned lane = threadIdx.x % 32;
    const uint32_t part_first = mine.first - kLaneClusters * lane;
    const bool asks = mine.first < mine.bundle->table.num_clusters() &&
                      may_draw(mine.bundle->table, mine.bounds(), view, rule, tolerances);
    unsigned todo = __ballot_sync(kAllLanes, asks), found = 0;
    while (todo != 0) {
        unsigned owners = 0, owner = 32;  // in bytes; that this lane asks for
        for (unsigned at = 0; at < 32; at += kLaneClusters) {
            const unsigned next = todo != 0 ? __ffs(todo) - 1 : 32;
            todo &= todo - 1;
            owners |= next << at;
            if (lane / kLaneClusters == at / kLaneClusters) owner = next;
        }
        const uint32_t c = part_first + kLaneClusters * owner + lane % kLaneClusters;
        const bool is_one = owner < 32 && c < mine.bundle->table.num_clusters();
        const int32_t answer = is_one ? static_cast<int32_t>(ask(static_cast<int32_t>(c))) : 0;
        const unsigned bits = __ballot_sync(kAllLanes, answer > 0);
        unsigned from = 32;  // where this lane's clusters were asked
        for (unsigned at = 0; at < 32; at += kLaneClusters)
            if ((owners >> at & 255) == lane) {
                found = bits >> at & 255;
                from = at;
            }
        if (weights != nullptr) keep_weights(answer, from, *weights);
    }
    return found;
}

}  // namespace cuda
}  // namespace v3dg
