#pragma once

// Bounds of neighbouring clusters that hold for every view, so that selection can skip
// several clusters at once. The tests that use the bounds are in select/bounds_math.h.

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
    bool has_leaf;  // some cluster has no own group
    bool has_root;  // some cluster has no parent group
};

// [ceil(C / kClustersOfBounds)]
std::vector<ClusterBounds> bounds_of_clusters(const ClusterTable& table);

constexpr uint32_t kMostRuns = 24;

// The clusters of a table, divided into a few runs that selection tests with one
// distance to the whole bundle. A table is ordered by level, so most runs of a distant
// instance are too fine, and some runs of a near one are too coarse. Sizes halve from
// run to run: each run has as many clusters as all runs after it together. The last run
// has the clusters of one ClusterBounds.
struct ClusterRuns {
    uint32_t count;
    uint32_t begin[kMostRuns + 1];  // first cluster of each run, a multiple of kClustersOfBounds,
                                    // and the end of the last one
    Ball groups;                    // contains the centres of the balls of all groups
    float least_distance;           // distance from a ball from which on the tests are valid
    int32_t least_level;            // smallest level of all groups
    // Two bounds on radius times square root of weight: the largest value among the
    // parent groups, or NaN if a cluster has none, and the smallest value among the own
    // groups, or 0 if a cluster has none.
    float most_parent[kMostRuns];
    float least_own[kMostRuns];
};

ClusterRuns runs_of_clusters(const ClusterTable& table);

}  // namespace v3dg
