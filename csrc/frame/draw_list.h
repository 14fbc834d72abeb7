#pragma once

// Runs of gaussians in front of cameras: the input of a frame.

#include <cstdint>

#include "frame/counters.h"
#include "math/gaussian.h"
#include "math/view.h"

namespace v3dg {

struct Codes;

// The drawing style of gaussians. Neighbours in memory of the same appearance are drawn together.
template <class T>
struct Appearance {
    T filter_px2;      // added to the variances on screen
    bool antialiased;  // the opacity compensates for the filter
    bool is_limited;   // the filter of far narrower gaussians is limited (project_math.h)

    V3DG_HD bool operator==(const Appearance& other) const {
        return filter_px2 == other.filter_px2 && antialiased == other.antialiased &&
               is_limited == other.is_limited;
    }
};

// A run of gaussians of one model, placed in front of the camera.
template <class T>
struct Draw {
    const GaussianPlanes<T>* model;  // null where there are codes
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

// A model in front of a picture's camera. It is aligned, so that threads write it in few
// instructions.
struct alignas(16) Placement {
    ModelView<float> view;
    uint32_t model, image;
};

// Neighbouring gaussians of a placed model, or of a model that several placements share: those at
// `placement` + k for each bit k of `sharers`, where it is not 0. They must have one picture, and
// make at most kItemSize records. These have room from `record` on and stand at its beginning,
// ordered by gaussian and then by placement. The first gaussian belongs to `cluster` of the model,
// or to one of the kItemClusters - 1 after that.
struct DrawItem {
    uint32_t placement, first, count, record;
    Appearance<float> appearance;
    uint32_t sharers, cluster;
    float weight;  // factor of opacities, below 1 in a fade
};

// The destination of a frame's items, in their order. The writer counts all items, and stores those
// that there is room for: counters->items is their number, and counters->gaussians the end of the
// last item's records. Items that would end past record_capacity need not be stored.
struct ItemList {
    DrawItem* items;
    FrameCounters* counters;
    unsigned long long item_capacity, record_capacity;
    unsigned long long* zeros;  // the zeros that the frame was asked for, for the writer

    V3DG_HD bool has_room_for(unsigned long long num_items,
                              unsigned long long num_gaussians) const {
        const Capacity capacity{.items = item_capacity,
                                .records = record_capacity,
                                .large = 0,
                                .entries = 0,
                                .spread = 0};
        return capacity.holds_items(num_items, num_gaussians);
    }
    // Returns whether all items that the writer has counted are stored.
    V3DG_HD bool is_complete() const { return has_room_for(counters->items, counters->gaussians); }
};

}  // namespace cuda
}  // namespace v3dg
