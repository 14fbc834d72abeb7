#pragma once

// Bounds of neighbouring clusters that hold for every view, so that selection can skip the clusters
// together. The tests that use them are in select_math.h.

#include <vector>

#include "residency/cluster_table.h"

namespace v3dg {

constexpr size_t kClustersOfBounds = 8;

struct ClusterBounds {
    Box box;       // contains the boxes of the clusters
    Ball parents;  // contains the centres of the balls of their parent groups
    Ball owns;     // contains the centres of the balls of their own groups
    float most_parent_radius;
    float most_parent_weight;
    float least_own_radius;
    float least_own_weight;
    int32_t least_own_level;
    bool has_leaf;  // some cluster has no group of its own
    bool has_root;  // some cluster has no parent group
};

// [ceil(C / kClustersOfBounds)]
std::vector<ClusterBounds> bounds_of_clusters(const ClusterTable& table);

constexpr uint32_t kMostRuns = 24;

// The clusters of a table in a few runs, which one distance to the whole bundle tests. A table is
// ordered by level, so most runs of a distant instance are too fine, and some of a near one are too
// coarse. Like a level, a run has as many clusters as all runs after it; the last run has the
// clusters of one ClusterBounds.
struct ClusterRuns {
    uint32_t count;
    uint32_t begin[kMostRuns + 1];  // first cluster of each run, a multiple of kClustersOfBounds,
                                    // and the end of the last one
    Ball groups;                    // contains the centres of the balls of all groups
    float least_distance;           // to a ball from which on the tests are valid
    int32_t least_level;            // of all groups
    // Radius times square root of the weight: the largest of the parent groups, or NaN if a cluster
    // has none, and the smallest of the own groups, or 0 if a cluster has none.
    float most_parent[kMostRuns];
    float least_own[kMostRuns];
};

ClusterRuns runs_of_clusters(const ClusterTable& table);

}  // namespace v3dg
