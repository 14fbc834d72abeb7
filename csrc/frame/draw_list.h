#pragma once

// The input of a frame: runs of gaussians in front of cameras.

#include <cstdint>

#include "frame/counters.h"
#include "math/gaussian.h"
#include "math/view.h"

namespace v3dg {

struct Codes;

// How gaussians are drawn. Neighbours in memory with the same appearance are drawn
// together.
template <class T>
struct Appearance {
    T filter_px2;      // added to the variances on screen
    bool antialiased;  // the opacity compensates for the filter
    bool is_limited;   // whether the filter of far narrower gaussians is limited (project_math.h)

    V3DG_HD bool operator==(const Appearance& other) const {
        return filter_px2 == other.filter_px2 && antialiased == other.antialiased &&
               is_limited == other.is_limited;
    }
};

// A run of gaussians of one model, placed in front of the camera.
template <class T>
struct Draw {
    const GaussianPlanes<T>* model;  // null if the gaussians are codes
    uint64_t first, count;
    ModelView<T> view;
    Appearance<T> appearance;
    Palette palette{};
    const Codes* codes = nullptr;
    T weight = 1;                          // factor of opacities: of an instance, and in a fade
    const float* color_factors = nullptr;  // [3] of colours that are not a palette's; null: none
};

namespace cuda {

// The largest number of records of an item: the number of threads of a block.
constexpr int kItemSize = 256;
constexpr unsigned kItemClusters = 8;

// A model in front of a picture's camera. The struct is aligned so that threads write
// it in few instructions.
struct alignas(16) Placement {
    ModelView<float> view;
    uint32_t model, image;
};

// Neighbouring gaussians of a placed model, or of a model that several placements
// share. In the second case `sharers` is not 0, and the placements are `placement` + k
// for each of its bits k; all of them are in one picture. An item has at most kItemSize
// records, which are written from `record` on, ordered by gaussian and then by
// placement. The first gaussian belongs to `cluster` of the model, or to one of the
// next kItemClusters - 1 clusters.
struct DrawItem {
    uint32_t placement, first, count, record;
    Appearance<float> appearance;
    uint32_t sharers, cluster;
    float weight;  // factor of opacities, below 1 in a fade
};

// The destination of a frame's items, in order. The kernel that writes them counts all
// items, and stores those that there is room for: counters->items is their number, and
// counters->gaussians the end of the last item's records. Items that would end beyond
// record_capacity need not be stored.
struct ItemList {
    DrawItem* items;
    FrameCounters* counters;
    unsigned long long item_capacity, record_capacity;
    unsigned long long* zeros;  // zeros that the frame was asked to provide

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
