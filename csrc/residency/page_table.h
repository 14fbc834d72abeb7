#pragma once

#include <cstdint>

#include "base/span.h"

namespace v3dg {

constexpr int64_t kAbsentPage = INT64_MIN;

// A page fades in over so many frames (page_arrivals.h).
constexpr int32_t kArrivalFrames = 8;
constexpr int32_t kNeverBegins = INT32_MAX, kBegunLongAgo = -kArrivalFrames;

// Where the pages of a bundle lie in memory, and which of them are there. Page g holds the clusters
// that group g replaces, the last page those that nothing replaces.
//
// The cut refines only what is there. It stays exact as long as a page is resident only together
// with the pages above it, of which the last one is resident always.
struct PageTable {
    // [G + 1] by how many rows a page lies behind its place in the bundle, or kAbsentPage. Empty:
    // all pages are there, in the order of the bundle.
    Span<const int64_t> shift;
    // The same of its clusters, modulo 2^32, for who reads ranges by cluster. Empty: they are where
    // the bundle has them.
    Span<const uint32_t> cluster_shift;
    // [G + 1] the frame after which a page begins to fade in, of cuts with a fade. No page is
    // farther than the one above it, in whichever frame. Empty: all pages have faded in.
    Span<const int32_t> begins;

    V3DG_HD bool is_whole() const { return shift.empty(); }
    V3DG_HD bool is_resident(size_t page) const { return is_whole() || shift[page] != kAbsentPage; }
    // How many of its frames a page has behind it.
    V3DG_HD int32_t arrived(size_t page, int32_t frame) const {
        const int32_t begin = begins.empty() ? kBegunLongAgo : begins[page];
        if (frame <= begin) return 0;
        return frame - begin < kArrivalFrames ? frame - begin : kArrivalFrames;
    }
};

// A page that a cut needs, and how urgently; select_math.h says what priorities are.
struct PageRequest {
    uint32_t bundle, page;
    float priority;
};

}  // namespace v3dg
