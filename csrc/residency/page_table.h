#pragma once

// The page table of a bundle: which pages are resident, and where they are in memory.

#include <cstdint>

#include "base/span.h"

namespace v3dg {

constexpr int64_t kAbsentPage = INT64_MIN;

// Number of frames in which a page fades in (page_arrivals.h).
constexpr int32_t kArrivalFrames = 8;
constexpr int32_t kNeverBegins = INT32_MAX, kBegunLongAgo = -kArrivalFrames;

// The locations of a bundle's pages in memory. Page g has the clusters that group g
// replaces, and the last page has those that no group replaces.
//
// A cut refines only groups whose page is resident. It is exact if, for each resident
// page, all pages above it are resident. The last page is always resident.
struct PageTable {
    // [G + 1] the first row of a page in memory minus its first row in the bundle, or
    // kAbsentPage. If the array is empty, all pages are resident, in the order of the
    // bundle.
    Span<const int64_t> shift;
    // [G + 1] the first cluster entry of a page in memory minus its first cluster in
    // the bundle, modulo 2^32. It is used to find the ranges of clusters. If the array
    // is empty, clusters are in the order of the bundle.
    Span<const uint32_t> cluster_shift;
    // [G + 1] the frame after which a page begins to fade in, for cuts with a fade. In
    // each frame, a page has faded in at most as far as the page above it. If the array
    // is empty, all pages have faded in.
    Span<const int32_t> begins;

    V3DG_HD bool is_whole() const { return shift.empty(); }
    V3DG_HD bool is_resident(size_t page) const { return is_whole() || shift[page] != kAbsentPage; }
    // Returns the number of frames for which a page has been fading in, 0 to
    // kArrivalFrames.
    V3DG_HD int32_t arrived(size_t page, int32_t frame) const {
        const int32_t begin = begins.empty() ? kBegunLongAgo : begins[page];
        if (frame <= begin) return 0;
        return frame - begin < kArrivalFrames ? frame - begin : kArrivalFrames;
    }
};

// A page that a cut needs, and its priority (select/page_need.h).
struct PageRequest {
    uint32_t bundle, page;
    float priority;
};

}  // namespace v3dg
