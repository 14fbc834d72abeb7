#pragma once

// The counters of a CUDA frame on the device, and the capacities of its buffers.

#include "base/host_device.h"

namespace v3dg {
namespace cuda {

// The result of a budget: the tolerance that was used; or, if the coarsest cut exceeds
// the budget, its number of gaussians `least`, and nothing was selected.
struct CutChoice {
    float tolerance_px2;
    bool exceeds_budget;
    unsigned long long least;
};

// Counters on the device; all start at 0. Elements beyond a capacity are counted but
// not stored, and then nothing is drawn.
struct FrameCounters {
    unsigned long long items, gaussians, in_frustum, records, entries;
    unsigned long long large;   // records over many tiles, or parts of those, in whole batches
    unsigned long long spread;  // scratch entries that lists need
    unsigned long long slots;   // gradient slots, in a frame with a tape
    CutChoice choice;           // valid if there is a budget
};

// Counts of one image of a frame, for frames that report them.
struct ImageCounts {
    unsigned long long gaussians, in_frustum;
};

// The numbers of elements that a frame's buffers hold.
struct Capacity {
    unsigned long long items, records, large, entries, spread;

    bool operator==(const Capacity& other) const {
        return items == other.items && records == other.records && large == other.large &&
               entries == other.entries && spread == other.spread;
    }
    // These two functions have no branches, so that a kernel loads all counters at
    // once.
    V3DG_HD bool holds_items(unsigned long long num_items, unsigned long long num_gaussians) const {
        return (num_items <= items) & (num_gaussians <= records);
    }
    // Returns whether there is room for all elements that are counted before lists are
    // spread.
    V3DG_HD bool holds_entries(const FrameCounters& counters) const {
        return holds_items(counters.items, counters.gaussians) & (counters.large <= large) &
               (counters.entries <= entries);
    }
    // Returns whether there is room for all elements that have been counted so far.
    V3DG_HD bool holds(const FrameCounters& counters) const {
        return holds_entries(counters) & (counters.spread <= spread);
    }
};

}  // namespace cuda
}  // namespace v3dg
