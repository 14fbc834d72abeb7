#pragma once

#include <cstdint>

#include "base/span.h"

namespace v3dg {

constexpr int64_t kAbsentPage = INT64_MIN;

// Where the pages of a bundle lie in memory, and which of them are there. Page g holds the clusters that
// group g replaces, the last page those that nothing replaces.
//
// The cut refines only what is there. It stays exact as long as a page is resident only together with the
// pages above it, of which the last one is resident always.
struct PageTable {
    // [G + 1] by how many rows a page lies behind its place in the bundle, or kAbsentPage. Empty: all pages
    // are there, in the order of the bundle.
    Span<const int64_t> shift;
    // The same of its clusters, modulo 2^32, for who reads ranges by cluster. Empty: they are where the
    // bundle has them.
    Span<const uint32_t> cluster_shift;

    V3DG_HD bool is_whole() const { return shift.empty(); }
    V3DG_HD bool is_resident(size_t page) const { return is_whole() || shift[page] != kAbsentPage; }
};

// A page that a cut needs, and how urgently; select_math.h says what priorities are.
struct PageRequest {
    uint32_t bundle, page;
    float priority;
};

}  // namespace v3dg
