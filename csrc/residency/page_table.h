#pragma once

// The page table of a bundle: it says which pages are resident, where they lie, and
// which pages a cut needs.

#include <cstdint>

#include "base/span.h"

namespace v3dg {

constexpr int64_t kAbsentPage = INT64_MIN;

// The number of frames over which a page fades in (page_arrivals.h).
constexpr int32_t kArrivalFrames = 8;
constexpr int32_t kNeverBegins = INT32_MAX, kBegunLongAgo = -kArrivalFrames;

// The locations of a bundle's pages in memory, and which of them are resident. Page g
// holds the clusters that group g replaces; the last page holds those that no group
// replaces.
//
// A cut refines only groups whose page is resident. The cut stays exact as long as each
// page is resident only together with all pages above it; the last page is always
// resident.
struct PageTable {
    // [G + 1] the first row of a page in memory minus its first row in the bundle, or
    // kAbsentPage. If empty, all pages are resident, in the order of the bundle.
    Span<const int64_t> shift;
    // [G + 1] the first cluster entry of a page in memory minus its first cluster in
    // the bundle, modulo 2^32; used to read the ranges of clusters. If empty, clusters
    // have the order of the bundle.
    Span<const uint32_t> cluster_shift;
    // [G + 1] the frame after which a page begins to fade in, for cuts with a fade. In
    // every frame a page has faded in at most as far as the page above it. If empty,
    // all pages have faded in.
    Span<const int32_t> begins;

    V3DG_HD bool is_whole() const { return shift.empty(); }
    V3DG_HD bool is_resident(size_t page) const { return is_whole() || shift[page] != kAbsentPage; }
    // Returns for how many of kArrivalFrames frames a page has been fading in, up to
    // `frame`.
    V3DG_HD int32_t arrived(size_t page, int32_t frame) const {
        const int32_t begin = begins.empty() ? kBegunLongAgo : begins[page];
        if (frame <= begin) return 0;
        return frame - begin < kArrivalFrames ? frame - begin : kArrivalFrames;
    }
};

// A page that a cut needs, and its priority, which select/page_need.h defines.
struct PageRequest {
    uint32_t bundle, page;
    float priority;
};

}  // namespace v3dg
