#pragma once

// The counters of a CUDA frame, in device memory, and the capacities of its buffers.

#include "base/host_device.h"

namespace v3dg {
namespace cuda {

// The result of selecting a cut within a budget of gaussians. It has the tolerance that
// was used. If even the coarsest cut exceeds the budget, nothing is selected, and
// `least` is the number of gaussians in the coarsest cut.
struct CutChoice {
    float tolerance_px2;
    bool exceeds_budget;
    unsigned long long least;
};

// Numbers of elements, in device memory. All of them start at 0. Elements beyond a
// capacity are counted, but not stored; nothing is drawn then.
struct FrameCounters {
    unsigned long long items, gaussians, in_frustum, records, entries;
    // Large records or parts of them, including the padding of batches.
    unsigned long long large;
    unsigned long long spread;  // number of list entries that need scratch memory
    unsigned long long slots;   // number of gradient slots, for a frame with a tape
    CutChoice choice;           // only valid if the cut has a budget
};

// The counts of one image, for frames that report counts of images.
struct ImageCounts {
    unsigned long long gaussians, in_frustum;
};

// The capacities of a frame's buffers, in elements.
struct Capacity {
    unsigned long long items, records, large, entries, spread;

    bool operator==(const Capacity& other) const {
        return items == other.items && records == other.records && large == other.large &&
               entries == other.entries && spread == other.spread;
    }
    // Returns whether the buffers have room for `num_items` items and `num_gaussians`
    // gaussians. This function and the next one have no branches, so that a kernel
    // loads all counters at once.
    V3DG_HD bool holds_items(unsigned long long num_items, unsigned long long num_gaussians) const {
        return (num_items <= items) & (num_gaussians <= records);
    }
    // Returns whether the buffers have room for all counted elements.
    // FrameCounters::spread is ignored, because it is counted later.
    V3DG_HD bool holds_entries(const FrameCounters& counters) const {
        return holds_items(counters.items, counters.gaussians) & (counters.large <= large) &
               (counters.entries <= entries);
    }
    // Returns whether the buffers have room for all counted elements.
    V3DG_HD bool holds(const FrameCounters& counters) const {
        return holds_entries(counters) & (counters.spread <= spread);
    }
};

}  // namespace cuda
}  // namespace v3dg
