#pragma once

// What a CUDA frame counts on the device.

namespace v3dg {
namespace cuda {

// What a budget came to: the tolerance that was used, or that the coarsest cut, of `least` gaussians, exceeds
// it and nothing was selected.
struct CutChoice {
    float tolerance_px2;
    bool exceeds_budget;
    unsigned long long least;
};

// Counted on the device. What exceeds a capacity is counted but not stored, and nothing is then drawn.
struct FrameCounters {
    unsigned long long items, gaussians, in_frustum, records, entries;
    unsigned long long slots;  // of gradients, in a frame that keeps a tape
    CutChoice choice;          // where there is a budget
};

}  // namespace cuda
}  // namespace v3dg
