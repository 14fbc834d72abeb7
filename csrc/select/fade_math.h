#pragma once

// Compares a metric with the tolerance, and computes how far a group is refined.

#include <cstdint>

#include "residency/cluster_table.h"
#include "select/rule.h"

namespace v3dg {

// Return whether a group fits the tolerance, and whether it is refined. Without a fade,
// exactly one of the two is true. With a fade, neither is true if the metric is within
// the fade's factor of the tolerance.
V3DG_HD inline bool fits(float metric_px2, const SelectRule& rule) {
    return metric_px2 * rule.fade.factor <= rule.tolerance_px2;
}
V3DG_HD inline bool is_refined(float metric_px2, const SelectRule& rule) {
    return !(metric_px2 * rule.fade.inverse <= rule.tolerance_px2);
}

// The weight 1. Weights are integers in units of 1 / kWhole, so that sums of weights
// are exact.
constexpr int32_t kWhole = 1 << 15;

V3DG_HD inline float share_of(int32_t weight) {
    return static_cast<float>(weight) * (1.0f / kWhole);
}

// Returns how far a group is refined: 0 if it fits, kWhole if it is refined completely,
// and a linear ramp in between. The result never decreases as the metric grows, because
// each step of the computation is monotonic.
V3DG_HD inline int32_t refinement(float metric_px2, const SelectRule& rule) {
    const float low = rule.tolerance_px2 * rule.fade.inverse,
                high = rule.tolerance_px2 * rule.fade.factor;
    const float ramp = (metric_px2 - low) / (high - low);
    // NaN becomes 0
    const float between = ramp > 0.0f ? (ramp < 1.0f ? ramp : 1.0f) : 0.0f;
    const int32_t rounded = static_cast<int32_t>(between * kWhole + 0.5f);
    return fits(metric_px2, rule) ? 0 : is_refined(metric_px2, rule) ? kWhole : rounded;
}

// Returns how far the page of a group has faded in, from 0 to kWhole. The refinement of
// the group is limited to this value. Neither of them decreases towards the root, so
// their minimum does not decrease either, and the cut stays exact.
V3DG_HD inline int32_t arrival(const PageTable& pages, int32_t g, const SelectRule& rule) {
    static_assert(kWhole % kArrivalFrames == 0,
                  "kWhole must be a multiple of the number of frames");
    return rule.fade.is_on() ? pages.arrived(g, rule.frame) * (kWhole / kArrivalFrames) : kWhole;
}

}  // namespace v3dg
