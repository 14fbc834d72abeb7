#pragma once

// The output lists of a cut: pairs, or the items of a frame. A lane first counts its
// elements. A prefix sum over all lanes then gives the position at which the lane
// writes them.

#include "select/cut_parts.cuh"

namespace v3dg {
namespace cuda {

// How much a lane will write.
struct WriteCount {
    unsigned units, gaussians;  // `units`: number of list elements
};

// A list of selected pairs (instance, cluster), with weights if there is a fade.
template <bool kHasFade>
struct PairOutput {
    static constexpr bool kFades = kHasFade;
    int32_t *instance, *cluster;
    float* weight;
    Count capacity;
    Count *pairs, *gaussians;

    __device__ WriteCount count(const LaneClusters& mine) const {
        WriteCount count{0, 0};
        for (unsigned k = 0; k < kLaneClusters; ++k)
            if (mine.drawn >> k & 1) {
                ++count.units;
                count.gaussians += mine.size(k);
            }
        return count;
    }
    __device__ void write(const LaneClusters& mine, Count first, Count) const {
        for (unsigned k = 0; k < kLaneClusters; ++k)
            if (mine.drawn >> k & 1) {
                if (first >= capacity) return;
                instance[first] = static_cast<int32_t>(mine.place);
                if (kFades) weight[first] = share_of(mine.weights[k]);
                cluster[first++] = mine.cluster(k);
            }
    }
    __device__ void finish(Count units, Count gaussians_drawn) const {
        *pairs = units;
        *gaussians = gaussians_drawn;
    }
};

// One drawn element. If `sharers` is 0, it consists of adjacent clusters of the lane's
// instance. Otherwise it is one cluster of several instances, and bit j of `sharers` is
// set for instance j of the part.
struct DrawnRun {
    unsigned k, num_clusters;
    uint32_t sharers;
    unsigned num_instances;

    __device__ unsigned gaussians_an_item() const { return kItemSize / num_instances; }
};

// Returns whether a warp draws one cluster of several instances faster as a shared
// item. In a shared item, it processes the gaussians one by one, each for all instances
// at once. Otherwise, it processes the instances one by one, 32 gaussians at a time.
// Starting an item costs as much as two such steps.
__device__ inline bool is_worth_sharing(unsigned num_gaussians, unsigned num_instances) {
    return num_instances > 1 &&
           num_gaussians <= num_instances * (blocks_for(num_gaussians, 32) + 2);
}

// Calls visit(DrawnRun) for each drawn element, in the lane that writes it. All lanes
// of the warp must call it. With a fade, adjacent clusters with different weights are
// separate elements.
template <bool kFades, class Visit>
__device__ void for_each_drawn(const LaneClusters& mine, const Visit& visit) {
    if (!mine.is_alone) {
        if (mine.drawn == 0) return;
        const unsigned joins = mine.bundle->joins[mine.first / kLaneClusters];
        for (unsigned k = 0, end; k < kLaneClusters; k = end) {
            end = k + 1;
            if ((mine.drawn >> k & 1) == 0) continue;
            while ((mine.drawn & joins) >> end & 1) {
                if (kFades && mine.weights[end] != mine.weights[k]) break;
                ++end;
            }
            visit(DrawnRun{.k = k, .num_clusters = end - k, .sharers = 0, .num_instances = 1});
        }
        return;
    }
    static_assert(alignof(BundleOnDevice) > 1,
                  "the lowest bit of the address must be 0, because are_tops uses it");
    const auto same_clusters = reinterpret_cast<unsigned long long>(mine.bundle) | mine.are_tops;
    const unsigned same = __match_any_sync(kAllLanes, same_clusters);
    for (unsigned k = 0; __any_sync(kAllLanes, mine.drawn >> k != 0); ++k) {
        const bool is_drawn = (mine.drawn >> k & 1) != 0;
        const bool is_whole = is_drawn && (!kFades || mine.weights[k] == kWhole);
        const unsigned sharers = __ballot_sync(kAllLanes, is_whole) & same, count = __popc(sharers);
        if (!is_drawn) continue;
        if (!is_whole || !is_worth_sharing(mine.size(k), count))
            visit(DrawnRun{.k = k, .num_clusters = 1, .sharers = 0, .num_instances = 1});
        else if (threadIdx.x % 32 + 1 == static_cast<unsigned>(__ffs(sharers)))
            visit(DrawnRun{.k = k, .num_clusters = 1, .sharers = sharers, .num_instances = count});
    }
}

// The selected clusters as items of a frame. Adjacent clusters of an instance share an
// item, and so may consecutive instances of one coarse cluster. Each item is written
// once per picture.
template <bool kHasFade>
struct ItemOutput {
    static constexpr bool kFades = kHasFade;
    ItemList items;
    uint32_t num_pictures, num_placements;  // `num_placements`: in one picture

    __device__ WriteCount count(const LaneClusters& mine) const {
        WriteCount count{0, 0};
        for_each_drawn<kFades>(mine, [&](const DrawnRun& run) {
            const unsigned size = mine.size(run.k, run.num_clusters);
            count.units += num_pictures * blocks_for(size, run.gaussians_an_item());
            count.gaussians += num_pictures * run.num_instances * size;
        });
        return count;
    }
    __device__ void write(const LaneClusters& mine, Count first, Count record) const {
        for_each_drawn<kFades>(mine, [&](const DrawnRun& run) {
            static_assert(kLaneClusters <= kItemClusters,
                          "all clusters of a lane may be in one item");
            const int32_t cluster = mine.cluster(run.k);
            const unsigned size = mine.size(run.k, run.num_clusters),
                           step = run.gaussians_an_item();
            const uint32_t placement =
                run.sharers == 0 ? mine.place : mine.place - threadIdx.x % 32;
            const uint32_t gaussian = static_cast<uint32_t>(mine.bundle->table.first_row(cluster));
            const uint32_t place = mine.bundle->table.place_of(cluster);
            const ClusterAppearance& appearances = mine.bundle->appearance;
            const Appearance<float> appearance =
                kFades ? appearances.faded(mine.bundle->table, cluster) : appearances[cluster];
            const float weight = kFades ? share_of(mine.weights[run.k]) : 1.0f;
            for (uint32_t picture = 0; picture < num_pictures; ++picture)
                for (unsigned skip = 0; skip < size; skip += step, ++first) {
                    const unsigned count = min(step, size - skip);
                    if (first < items.item_capacity &&
                        record + run.num_instances * count <= items.record_capacity)
                        items.items[first] = {.placement = placement + picture * num_placements,
                                              .first = gaussian + skip,
                                              .count = count,
                                              .record = static_cast<uint32_t>(record),
                                              .appearance = appearance,
                                              .sharers = run.sharers,
                                              .cluster = place,
                                              .weight = weight};
                    record += run.num_instances * count;
                }
        });
    }
    __device__ void finish(Count units, Count gaussians) const {
        items.counters->items = units;
        items.counters->gaussians = gaussians;
    }
};

}  // namespace cuda
}  // namespace v3dg
