#pragma once

// The returns of a pulse of light: the layers along a ray.

#include <cmath>
#include <cstddef>

#include "base/host_device.h"
#include "base/span.h"

namespace v3dg {

constexpr int kMostReturns = 2;

// Returns the luma of a colour: ITU-R BT.709, on the values that a picture has.
V3DG_HD inline float luma_of(const float rgb[3]) {
    return 0.2126f * rgb[0] + 0.7152f * rgb[1] + 0.0722f * rgb[2];
}

// The light that one gaussian sends back on a ray: its distance, its blend weight, and
// the luma of its colour. The contributions of a ray are ordered by range.
struct Contribution {
    float range, weight, luma;
};

// How layers are told apart. A layer is detected where the weights since the last layer
// add up to at least `least_weight`. It contains these contributions, and all that
// follow within `gap` behind that place.
struct ReturnRule {
    float least_weight, gap;
};

// One layer: the range at which half of its weight is reached, its weight, and the sum
// of its weights times luma. A layer that is not there has an infinite range.
struct Return {
    float range, weight, intensity;
};

// Finds the layers of a ray, the nearest first.
V3DG_HD inline void find_returns(Span<const Contribution> ray, const ReturnRule& rule,
                                 Return found[kMostReturns]) {
    size_t next = 0;
    for (int k = 0; k < kMostReturns; ++k) {
        found[k] = {INFINITY, 0, 0};
        const size_t first = next;
        float weight = 0;
        while (next < ray.size && weight < rule.least_weight) weight += ray[next++].weight;
        if (!(weight >= rule.least_weight)) continue;
        const float end = ray[next - 1].range + rule.gap;
        while (next < ray.size && ray[next].range <= end) weight += ray[next++].weight;
        float passed = 0, intensity = 0;
        found[k].range = ray[next - 1].range;
        for (size_t i = first; i < next; ++i) {
            const bool is_before = passed < 0.5f * weight;
            passed += ray[i].weight;
            intensity += ray[i].weight * ray[i].luma;
            if (is_before && passed >= 0.5f * weight) found[k].range = ray[i].range;
        }
        found[k].weight = weight;
        found[k].intensity = intensity;
    }
}

}  // namespace v3dg
