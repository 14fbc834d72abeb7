#pragma once

// Checks that the tables of a bundle are consistent, and that cuts of it are exact.

#include <cstdint>
#include <string>

#include "base/span.h"
#include "math/bounds.h"

namespace v3dg {

// The tables of a bundle with C clusters and G groups. Clusters are sorted by level,
// then by parent group. Groups are in the order of the clusters that they replace. The
// group -1 means no group.
struct GivenTables {
    Span<const int64_t> offset;        // [C + 1]
    Span<const int32_t> level;         // [C]
    Span<const int32_t> own_group;     // [C]
    Span<const int32_t> parent_group;  // [C]
    Span<const Box> box;               // [C]
    Span<const float> filter_px2;      // [C]
    Span<const uint8_t> antialiased;   // [C]
    Span<const Ball> ball;             // [G]
    Span<const float> weight;          // [G]
    Span<const int32_t> parent;        // [G]
    Span<const int32_t> group_level;   // [G]
    Span<const float> error;           // [G * 2]
};

// The first wrong row of a table. Row -1 means the last row.
struct TableFault {
    // Name of the table in files, or "groups" if a group has no clusters.
    std::string table;
    int64_t row;
    std::string expected;
};

// Throws TableFault unless the tables are valid; they may have any contents. Cuts are
// only exact if the metric never decreases towards the root. Therefore the ball and the
// weight of a group must not be smaller than those of any group below it.
void check_tables(const GivenTables& tables, int64_t num_gaussians);

}  // namespace v3dg
