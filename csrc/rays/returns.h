#pragma once

// Finds the returns of a pulse of light: the layers of gaussians along a ray.

#include <cmath>
#include <cstdint>

#include "base/host_device.h"

namespace v3dg {

constexpr int kMostReturns = 2;

// Returns the luma of a colour by ITU-R BT.709. The colour is not converted to linear
// light first.
V3DG_HD inline float luma_of(const float rgb[3]) {
    return 0.2126f * rgb[0] + 0.7152f * rgb[1] + 0.0722f * rgb[2];
}

// The light that one gaussian returns along a ray: its distance, its blend weight, and
// the luma of its colour. Contributions are processed in ascending order of range.
struct Contribution {
    float range, weight, luma;
};

// The rule that divides contributions into layers. A layer is detected as soon as the
// weights after the previous layer add up to at least `least_weight`. The layer
// includes all contributions up to this one, and those that follow within the distance
// `gap` of it.
struct ReturnRule {
    float least_weight, gap;
};

// One layer. `range` is the distance at which half of the layer's weight is reached, or
// infinity if there is no layer. `intensity` is the sum of weight times luma.
struct Return {
    float range, intensity;
};

// Finds the layers of a ray, nearest first. The contributions of the ray are added one
// by one.
//
// The range of a layer is its weighted median, which is only known when the layer ends.
// Until then, this class stores the contributions that can still be the median. A
// contribution is dropped once the weight up to it is less than half of the current
// weight. No more contributions are stored once the layer has taken half of the light
// that reached it. Each stored contribution takes at least 1/255 of at least half of
// that light, so there are fewer than kMostMedians.
class ReturnFinder {
  public:
    V3DG_HD void start(const ReturnRule& rule) {
        rule_ = rule;
        num_found_ = 0;
        for (int k = 0; k < kMostReturns; ++k) found_[k] = {INFINITY, 0};
        start_layer();
    }
    // Adds the next contribution. `transmittance` is the fraction of light that reaches
    // it.
    V3DG_HD void add(const Contribution& next, float transmittance) {
        if (num_found_ < kMostReturns && is_detected_ && !(next.range <= end_)) end_layer();
        if (num_found_ == kMostReturns) return;
        if (weight_ == 0) most_half_ = transmittance * 0.501f;
        const bool may_be_median = weight_ < most_half_;
        weight_ += next.weight;
        intensity_ += next.weight * next.luma;
        last_range_ = next.range;
        if (may_be_median) store({weight_, next.range});
        if (is_detected_ || !(weight_ >= rule_.least_weight)) return;
        is_detected_ = true;
        end_ = next.range + rule_.gap;
    }
    V3DG_HD void finish() {
        if (num_found_ < kMostReturns && is_detected_) end_layer();
    }
    V3DG_HD const Return& found(int k) const { return found_[k]; }

  private:
    static constexpr uint32_t kMostMedians = 136;
    // A contribution that may be the median: its range, and the layer's weight up to
    // and including it.
    struct Median {
        float passed, range;
    };

    V3DG_HD void start_layer() {
        weight_ = intensity_ = 0;
        first_ = size_ = 0;
        is_detected_ = false;
    }
    V3DG_HD void store(const Median& median) {
        drop_up_to(0.5f * weight_);
        // This cannot happen, but it keeps writes inside the array.
        if (size_ == kMostMedians) return;
        if (size_ == 0) nearest_ = median;
        const uint32_t place = first_ + size_;
        medians_[place < kMostMedians ? place : place - kMostMedians] = median;
        ++size_;
    }
    // Drops the stored contributions up to which the layer's weight is less than
    // `half`.
    V3DG_HD void drop_up_to(float half) {
        while (size_ > 0 && nearest_.passed < half) {
            first_ = first_ + 1 == kMostMedians ? 0 : first_ + 1;
            --size_;
            if (size_ > 0) nearest_ = medians_[first_];
        }
    }
    V3DG_HD void end_layer() {
        drop_up_to(0.5f * weight_);
        found_[num_found_] = {size_ > 0 ? nearest_.range : last_range_, intensity_};
        ++num_found_;
        start_layer();
    }

    ReturnRule rule_;
    Return found_[kMostReturns];
    int num_found_;
    bool is_detected_;
    float weight_, intensity_, most_half_, last_range_, end_;
    uint32_t first_, size_;
    Median nearest_;  // a copy of the first one, in registers
    Median medians_[kMostMedians];
};

}  // namespace v3dg
