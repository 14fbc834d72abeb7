#pragma once

// Checks that the tables of a bundle are consistent, and that they guarantee an exact
// cut.

#include <cstdint>
#include <string>

#include "base/span.h"
#include "math/bounds.h"

namespace v3dg {

// C clusters, by level, then by parent group; G groups, in the order of the clusters
// that they replace. Group -1 means none.
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

// Thrown for the first wrong row; -1 means the last row.
struct TableFault {
    std::string table;  // name of the table in files; "groups" for a group without clusters
    int64_t row;
    std::string expected;
};

// Throws TableFault unless the tables are valid, whatever their contents. A group's
// ball and weight must be at least those of the groups below, so that the metric never
// decreases towards the root.
void check_tables(const GivenTables& tables, int64_t num_gaussians);

}  // namespace v3dg
