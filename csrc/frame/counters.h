#pragma once

// What a CUDA frame counts on the device, and what it has room for.

#include "base/host_device.h"

namespace v3dg {
namespace cuda {

// What a budget came to: the tolerance that was used, or that the coarsest cut, of `least`
// gaussians, exceeds it and nothing was selected.
struct CutChoice {
    float tolerance_px2;
    bool exceeds_budget;
    unsigned long long least;
};

// Counted on the device, from 0. What exceeds a capacity is counted but not stored, and nothing is
// then drawn.
struct FrameCounters {
    unsigned long long items, gaussians, in_frustum, records, entries;
    unsigned long long large;   // records over many tiles, or parts of them, in whole batches
    unsigned long long spread;  // places of entries in the scratch that lists need
    unsigned long long slots;   // of gradients, in a frame that keeps a tape
    CutChoice choice;           // where there is a budget
};

// How many elements a frame's buffers have room for.
struct Capacity {
    unsigned long long items, records, large, entries, spread;

    bool operator==(const Capacity& other) const {
        return items == other.items && records == other.records && large == other.large &&
               entries == other.entries && spread == other.spread;
    }
    // Without branches in these two, so that a kernel loads all counters at once.
    V3DG_HD bool holds_items(unsigned long long num_items, unsigned long long num_gaussians) const {
        return (num_items <= items) & (num_gaussians <= records);
    }
    // All that is counted before lists are spread.
    V3DG_HD bool holds_entries(const FrameCounters& counters) const {
        return holds_items(counters.items, counters.gaussians) & (counters.large <= large) &
               (counters.entries <= entries);
    }
    // All that has been counted so far.
    V3DG_HD bool holds(const FrameCounters& counters) const {
        return holds_entries(counters) & (counters.spread <= spread);
    }
};

}  // namespace cuda
}  // namespace v3dg
