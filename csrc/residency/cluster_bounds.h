#pragma once

// Bounds on runs of adjacent clusters that hold for every view, so that selection can
// skip several clusters at once. select/bounds_math.h has the tests that use them.

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
    bool has_leaf;  // a cluster has no own group
    bool has_root;  // a cluster has no parent group
};

// Returns the bounds of every kClustersOfBounds clusters: [ceil(C /
// kClustersOfBounds)].
std::vector<ClusterBounds> bounds_of_clusters(const ClusterTable& table);

constexpr uint32_t kMostRuns = 24;

// The clusters of a table, divided into a few runs. Selection tests a run with a single
// distance, to the whole bundle. A table is ordered by level. So for a distant instance
// most runs are too fine, and for a near instance some runs are too coarse. Sizes halve
// from run to run: a run has as many clusters as all runs after it. The last run has
// the clusters of one ClusterBounds.
struct ClusterRuns {
    uint32_t count;
    // First cluster of each run, a multiple of kClustersOfBounds; and the end.
    uint32_t begin[kMostRuns + 1];
    Ball groups;           // contains the centres of the balls of all groups
    float least_distance;  // smallest distance to a ball for which the tests are valid
    int32_t least_level;   // smallest level of all groups
    // Bounds on radius * sqrt(weight) for each run. most_parent: the largest value of
    // the parent groups; NaN if a cluster has no parent group. least_own: the smallest
    // value of the own groups; 0 if a cluster has no own group.
    float most_parent[kMostRuns];
    float least_own[kMostRuns];
};

ClusterRuns runs_of_clusters(const ClusterTable& table);

}  // namespace v3dg
