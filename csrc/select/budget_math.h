#pragma once

// The tolerance of a budget: the list of tolerances to choose from, and how the choice
// moves from frame to frame.

#include <cmath>
#include <cstdint>
#include <cstring>

#include "math/lanes.h"
#include "select/rule.h"

namespace v3dg {

// A budget chooses from a list of tolerances, called bins: the tolerance of the rule,
// then 2048 per octave, then infinity. A metric belongs to the first bin that it fits;
// NaN belongs to the bin after the last.
constexpr int kLog2StepsPerOctave = 11, kOctaves = 32;
constexpr uint32_t kNumBudgetBins = 2 + (kOctaves << kLog2StepsPerOctave);
constexpr uint32_t kFirstStepBits = 0x3a800000u;  // the bits of the float 2^-10
constexpr int kStepShift = 23 - kLog2StepsPerOctave;

V3DG_HD inline uint32_t bin_of_metric(float metric, float tolerance) {
    if (metric <= tolerance) return 0;
    uint32_t bits;  // positive floats have the same order as their bits
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

// In steps, the tolerance of a budget moves towards a goal, at which 1 / kHeadroomParts
// of the budget stays free. This headroom makes leaps rare when new objects come into
// view. In motion a step is 1 / kStepParts of the distance to the goal, and at least
// kLeastStepBins. (The usual fade is 117 bins wide.) If the distance exceeds kLeapBins,
// the motion is not slow, and one step covers all of it. At rest the tolerance reaches
// the goal within kRestFrames, in steps of about equal size.
constexpr uint64_t kHeadroomParts = 32;
constexpr uint32_t kStepParts = 32, kLeastStepBins = 6, kLeapBins = 512;
constexpr int32_t kRestFrames = 8;
constexpr uint32_t kNoBin = ~uint32_t(0);  // the bin of the frame before the first

V3DG_HD inline uint64_t goal_of_budget(uint64_t budget) { return budget - budget / kHeadroomParts; }

// Returns the tolerance of this frame. `least` is the first bin from which on no cut
// exceeds the budget; `goal` is the same for the budget less its headroom, or
// kNumBudgetBins if there is no such bin. The result is never below the least bin,
// because a cut there would exceed the budget. `last` becomes the bin of this frame.
V3DG_HD inline float tolerance_of_budget(const SelectRule& rule, uint32_t least, uint32_t goal,
                                         uint32_t& last) {
    if (rule.pace == BudgetPace::at_once) return tolerance_of_bin(least, rule.tolerance_px2);
    // bins below this one are not used
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
    // The floor is a bin, rounded up from the rule's tolerance. So its cut may fit the
    // budget although the cut at exactly the rule's tolerance does not.
    return last == floor && least == 0 ? rule.tolerance_px2
                                       : tolerance_of_bin(last, rule.tolerance_px2);
}

}  // namespace v3dg
