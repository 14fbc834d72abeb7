#pragma once

// What a frame draws: runs of gaussians, placed in front of cameras.

#include <cstdint>

#include "frame/counters.h"
#include "math/gaussian.h"
#include "math/view.h"

namespace v3dg {

struct Codes;

// How gaussians are drawn, apart from where. Neighbours in memory of the same appearance are drawn
// together.
template <class T>
struct Appearance {
    T filter_px2;      // added to the variances on screen
    bool antialiased;  // the opacity makes up for what the filter adds
    bool is_limited;   // what a gaussian far narrower than the filter gets of it (project_math.h)

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
    T weight = 1;  // multiplies opacities; less of what fades
};

namespace cuda {

// Records that an item may make: as many as a block has threads.
constexpr int kItemSize = 256;
constexpr unsigned kItemClusters = 8;

// A model in front of a picture's camera. Aligned, so that threads write it in few instructions.
struct alignas(16) Placement {
    ModelView<float> view;
    uint32_t model, image;
};

// Neighbouring gaussians of a placed model, or of a model that several placements share: those at
// `placement` + k for each bit k of `sharers`, where it is not 0. They are to have one picture, and
// to make kItemSize records at most: there is room for those from `record` on, and they stand at
// its beginning, by gaussian and then by placement. The first gaussian belongs to `cluster` of the
// model, or to one of the kItemClusters - 1 after that.
struct DrawItem {
    uint32_t placement, first, count, record;
    Appearance<float> appearance;
    uint32_t sharers, cluster;
    float weight;  // multiplies opacities: 1, or less of what fades
};

// Where the items of a frame are written, in their order. Counts what there is, stores what there
// is room for: counters->items, and in counters->gaussians the end of the last item's records.
// Items that would end past record_capacity need not be stored.
struct ItemList {
    DrawItem* items;
    FrameCounters* counters;
    unsigned long long item_capacity, record_capacity;
    unsigned long long* zeros;  // as many as the frame was asked for, for whoever writes the items

    V3DG_HD bool has_room_for(unsigned long long num_items,
                              unsigned long long num_gaussians) const {
        return Capacity{item_capacity, record_capacity, 0, 0, 0}.holds_items(num_items,
                                                                             num_gaussians);
    }
    // For all that its writer has counted.
    V3DG_HD bool is_complete() const { return has_room_for(counters->items, counters->gaussians); }
};

}  // namespace cuda
}  // namespace v3dg
