#pragma once

// Computes the tolerance of a cut with a budget: the list of possible tolerances, and
// how the choice changes from frame to frame.

#include <cmath>
#include <cstdint>
#include <cstring>

#include "math/lanes.h"
#include "select/rule.h"

namespace v3dg {

// The tolerances that a budget chooses from are called bins. Bin 0 is the tolerance of
// the rule. Then follow 2048 bins per octave, and the last bin is infinity. A metric
// belongs to the first bin whose tolerance it fits, and NaN belongs to the bin after
// the last.
constexpr int kLog2StepsPerOctave = 11, kOctaves = 32;
constexpr uint32_t kNumBudgetBins = 2 + (kOctaves << kLog2StepsPerOctave);
constexpr uint32_t kFirstStepBits = 0x3a800000u;  // bits of 2^-10 as a float
constexpr int kStepShift = 23 - kLog2StepsPerOctave;

V3DG_HD inline uint32_t bin_of_metric(float metric, float tolerance) {
    if (metric <= tolerance) return 0;
    uint32_t bits;  // bits of positive floats have the same order as the floats
    std::memcpy(&bits, &metric, sizeof bits);
    if (bits <= kFirstStepBits) return 1;
    if (!(metric <= INFINITY)) return kNumBudgetBins;
    const uint32_t step = (bits - kFirstStepBits + (1u << kStepShift) - 1) >> kStepShift;
    return step + 1 < kNumBudgetBins ? step + 1 : kNumBudgetBins - 1;
}
V3DG_HD inline float tolerance_of_bin(uint32_t bin, float tolerance) {
    if (bin == 0) return tolerance;
    if (bin == kNumBudgetBins - 1) return INFINITY;
    const uint32_t bits = kFirstStepBits + ((bin - 1) << kStepShift);
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// With BudgetPace::in_steps, the tolerance moves towards a goal from frame to frame. At
// the goal, 1 / kHeadroomParts of the budget is unused, so that new objects in view
// rarely make the tolerance jump.
//
// While the camera moves, a step is 1 / kStepParts of the distance to the goal, but at
// least kLeastStepBins. (A default fade is 117 bins wide.) If the distance exceeds
// kLeapBins, a single step covers all of it. When nothing moves, the tolerance reaches
// the goal within kRestFrames, in steps of about equal size.
constexpr uint64_t kHeadroomParts = 32;
constexpr uint32_t kStepParts = 32, kLeastStepBins = 6, kLeapBins = 512;
constexpr int32_t kRestFrames = 8;
constexpr uint32_t kNoBin = ~uint32_t(0);  // there is no earlier frame

V3DG_HD inline uint64_t goal_of_budget(uint64_t budget) { return budget - budget / kHeadroomParts; }

// Returns the tolerance of this frame. `least` is the first bin from which on no cut
// exceeds the budget. `goal` is the same for the budget minus the headroom, or
// kNumBudgetBins if there is no such bin. The result is never below bin `least`. `last`
// is the bin of the earlier frame, and receives the bin of this frame.
V3DG_HD inline float tolerance_of_budget(const SelectRule& rule, uint32_t least, uint32_t goal,
                                         uint32_t& last) {
    if (rule.pace == BudgetPace::at_once) return tolerance_of_bin(least, rule.tolerance_px2);
    // The bin of the rule's tolerance, which is the lowest possible result.
    const uint32_t floor = bin_of_metric(rule.tolerance_px2, 0.0f);
    goal = max_of(floor, min_of(goal, kNumBudgetBins - 1));
    const uint32_t from = last == kNoBin ? goal : last,
                   way = goal > from ? goal - from : from - goal;
    const auto frames_left = static_cast<uint32_t>(kRestFrames + 1 - rule.frames_at_rest);
    const uint32_t in_motion = min_of(way, max_of(way / kStepParts, kLeastStepBins));
    uint32_t step = rule.frames_at_rest > 0 ? (way + frames_left - 1) / frames_left : in_motion;
    if (way > kLeapBins) step = way;
    if (rule.pace == BudgetPace::again) step = 0;
    last = max_of(max_of(least, floor), goal > from ? from + step : from - step);
    // Rounding up to a bin may turn a cut that exceeds the budget into one that fits.
    // Therefore the rule's exact tolerance is only used if it fits, too (`least` is 0).
    return last == floor && least == 0 ? rule.tolerance_px2
                                       : tolerance_of_bin(last, rule.tolerance_px2);
}

}  // namespace v3dg
