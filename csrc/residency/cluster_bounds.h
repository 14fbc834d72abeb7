#pragma once

// What holds of a few neighbouring clusters whatever the view, so that selection can pass over them together.
// The tests that read it are in select_math.h.

#include <vector>

#include "residency/cluster_table.h"

namespace v3dg {

constexpr size_t kClustersOfBounds = 8;

struct ClusterBounds {
    Box box;             // contains the boxes of the clusters
    Ball parents, owns;  // contain the centres of the balls of the groups above them, and of their own groups
    float most_parent_radius, most_parent_weight;
    float least_own_radius, least_own_weight;
    int32_t least_own_level;
    bool has_leaf, has_root;  // whether some cluster has no group of its own, or none above
};

// [ceil(C / kClustersOfBounds)]
std::vector<ClusterBounds> bounds_of_clusters(const ClusterTable& table);

}  // namespace v3dg
