#pragma once

// Checks that the tables of a bundle fit each other, and that they guarantee an exact cut.

#include <cstdint>
#include <string>

#include "base/span.h"
#include "math/bounds.h"

namespace v3dg {

// C clusters, by level, then by parent group; G groups, in the order of the clusters that they
// replace. Group -1 is none.
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

// Thrown for the first wrong row; row -1 is the last.
struct TableFault {
    std::string table;  // its name in files; "groups" for a group that clusters lack
    int64_t row;
    std::string expected;
};

// Throws TableFault unless the tables are valid; it trusts nothing in them. A group's ball and
// weight have to contain those below, so that the metric never decreases towards the root.
void check_tables(const GivenTables& tables, int64_t num_gaussians);

}  // namespace v3dg
