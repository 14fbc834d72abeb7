#pragma once

// Bounds on runs of adjacent clusters. They hold for every view, so that selection can
// skip several clusters at once. The tests that use them are in select/bounds_math.h.

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
    bool has_leaf;  // whether any cluster has no own group
    bool has_root;  // whether any cluster has no parent group
};

// Returns the bounds of every kClustersOfBounds clusters: [ceil(C /
// kClustersOfBounds)].
std::vector<ClusterBounds> bounds_of_clusters(const ClusterTable& table);

constexpr uint32_t kMostRuns = 24;

// The clusters of a table, divided into a few runs. Selection tests a run with a single
// distance to the whole bundle. A table is ordered by level. Therefore most runs are
// too fine for a distant instance, and some are too coarse for a near one. Sizes halve
// from run to run: each run has as many clusters as all runs after it together. The
// last run has the clusters of one ClusterBounds.
struct ClusterRuns {
    uint32_t count;
    // First cluster of each run, a multiple of kClustersOfBounds. The last element is
    // the end.
    uint32_t begin[kMostRuns + 1];
    Ball groups;           // contains the centres of the balls of all groups
    float least_distance;  // smallest distance to a ball for which the tests are valid
    int32_t least_level;   // smallest level of all groups
    // Bounds on radius * sqrt(weight) for each run. most_parent is the largest value of
    // the parent groups, or NaN if a cluster has no parent group. least_own is the
    // smallest value of the own groups, or 0 if a cluster has no own group.
    float most_parent[kMostRuns];
    float least_own[kMostRuns];
};

ClusterRuns runs_of_clusters(const ClusterTable& table);

}  // namespace v3dg
