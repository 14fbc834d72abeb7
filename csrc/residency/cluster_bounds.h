#pragma once

// What holds of neighbouring clusters whatever the view, so that selection can pass over them
// together. The tests that read it are in select_math.h.

#include <vector>

#include "residency/cluster_table.h"

namespace v3dg {

constexpr size_t kClustersOfBounds = 8;

struct ClusterBounds {
    Box box;  // contains the boxes of the clusters
    Ball parents,
        owns;  // contain the centres of the balls of the groups above them, and of their own groups
    float most_parent_radius, most_parent_weight;
    float least_own_radius, least_own_weight;
    int32_t least_own_level;
    bool has_leaf, has_root;  // whether some cluster has no group of its own, or none above
};

// [ceil(C / kClustersOfBounds)]
std::vector<ClusterBounds> bounds_of_clusters(const ClusterTable& table);

constexpr uint32_t kMostRuns = 24;

// The clusters of a table in a few runs, which are told apart by one distance to all of them.
// Levels follow each other in a table, so of a distant instance most runs are too fine, and of a
// near one some too coarse. As levels do, a run has as many clusters as all that follows it; the
// last has those of one bounds.
struct ClusterRuns {
    uint32_t count;
    uint32_t
        begin[kMostRuns + 1];  // first cluster of each, whole bounds, and where the last one ends
    Ball groups;               // contains the centres of the balls of all groups
    float least_distance;      // of a ball, from which on the tests hold
    int32_t least_level;       // of all groups
    // Radius times root of weight. Of the groups above, NaN where a cluster has none; of their own,
    // 0 where a cluster has none.
    float most_parent[kMostRuns], least_own[kMostRuns];
};

ClusterRuns runs_of_clusters(const ClusterTable& table);

}  // namespace v3dg
