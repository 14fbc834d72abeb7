#pragma once

// The input of a frame: runs of gaussians, placed in front of a camera.

#include <cstdint>

#include "frame/counters.h"
#include "math/gaussian.h"
#include "math/view.h"

namespace v3dg {

struct Codes;

// The settings with which a gaussian is drawn. Gaussians that are adjacent in memory
// and have equal settings are drawn together.
template <class T>
struct Appearance {
    T filter_px2;      // variance that is added on screen in x and in y
    bool antialiased;  // whether the opacity is reduced to compensate for the filter
    // Whether the filter is limited for very narrow gaussians (kMostFilterOfVariance).
    bool is_limited;

    V3DG_HD bool operator==(const Appearance& other) const {
        return filter_px2 == other.filter_px2 && antialiased == other.antialiased &&
               is_limited == other.is_limited;
    }
};

// A run of adjacent gaussians of one model, placed in front of the camera.
template <class T>
struct Draw {
    const GaussianPlanes<T>* model;  // null if the gaussians are coded
    uint64_t first, count;
    ModelView<T> view;
    Appearance<T> appearance;
    Palette palette{};
    const Codes* codes = nullptr;
    // multiplies the opacities; the product of the instance's opacity and a fade's
    // weight
    T weight = 1;
    // [3] multiply red, green and blue, but not colours of palettes; may be null
    const float* color_factors = nullptr;
};

namespace cuda {

// Maximum number of records of an item. It equals the number of threads of a block.
constexpr int kItemSize = 256;
constexpr unsigned kItemClusters = 8;

// A model that is placed in front of the camera of one picture. Because of its
// alignment, a thread can write a placement in few instructions.
struct alignas(16) Placement {
    ModelView<float> view;
    uint32_t model, image;
};

// A run of adjacent gaussians of a model that are drawn together. A shared item draws
// them at several placements of the model in one picture: `placement` + k for each bit
// k that is set in `sharers`. For all other items, `sharers` is 0.
//
// An item has at most kItemSize records. They begin at index `record`, and are ordered
// by gaussian, then by placement. The first gaussian belongs to one of kItemClusters
// clusters of the model, the first of which is `cluster`.
struct DrawItem {
    uint32_t placement, first, count, record;
    Appearance<float> appearance;
    uint32_t sharers, cluster;
    float weight;  // multiplies the opacities; below 1 in a fade
};

// The buffer for a frame's items. The kernel that writes items counts all of them in
// counters->items, but only stores as many as fit. counters->gaussians is the end of
// the last item's records. Items whose records end beyond record_capacity may be
// omitted.
struct ItemList {
    DrawItem* items;
    FrameCounters* counters;
    unsigned long long item_capacity, record_capacity;
    unsigned long long* zeros;  // zeroed memory that the writing kernel needs

    V3DG_HD bool has_room_for(unsigned long long num_items,
                              unsigned long long num_gaussians) const {
        const Capacity capacity{.items = item_capacity,
                                .records = record_capacity,
                                .large = 0,
                                .entries = 0,
                                .spread = 0};
        return capacity.holds_items(num_items, num_gaussians);
    }
    // Returns whether all counted items are stored.
    V3DG_HD bool is_complete() const { return has_room_for(counters->items, counters->gaussians); }
};

}  // namespace cuda
}  // namespace v3dg
