#pragma once

#include "residency/cluster_table.h"

namespace v3dg {

// Where the gaussians of a bundle's clusters lie in memory. How many a cluster has says ClusterTable::offset.
//
// So far a bundle is resident as a whole or not at all. Once single pages can be absent, a group whose finer
// clusters lie in an absent page has metric 0, as it has at SelectRule::min_level: it always fits, and what
// is below it is never drawn. The cut stays exact as long as a page is resident only together with the pages
// above it.
struct PageTable {
    Span<const int64_t> first_row;  // [C] among the rows of the bundle's resident gaussians

    // Whether the rows of cluster c begin where those of the cluster before it end.
    V3DG_HD bool follows(const ClusterTable& table, size_t c) const {
        return first_row[c] == first_row[c - 1] + table.num_gaussians(c - 1);
    }
};

// The rows of a bundle that is resident as a whole lie in the order of its clusters. Borrows from the table.
inline PageTable whole_bundle(const ClusterTable& table) {
    return {{table.offset.data, table.num_clusters()}};
}

}  // namespace v3dg
