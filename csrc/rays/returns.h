#pragma once

// The returns of a pulse of light: the layers along a ray.

#include <cmath>
#include <cstdint>

#include "base/host_device.h"

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

// One layer: the range at which half of its weight is reached, and the sum of its
// weights times luma. A layer that is not there has an infinite range.
struct Return {
    float range, intensity;
};

// Finds the layers of a ray, the nearest first, from one contribution after another.
//
// The range of a layer is known at its end, because that is where its weight is known.
// Until then it stores the contributions at which half of the weight may be reached:
// those behind which at least half of the weight so far has passed, as long as less
// than half of the light has passed that was left in front of the layer. Each of them
// has an alpha of at least 1/255 of at least half of that light, so fewer than
// kMostMedians are stored.
class ReturnFinder {
  public:
    V3DG_HD void start(const ReturnRule& rule) {
        rule_ = rule;
        num_found_ = 0;
        for (int k = 0; k < kMostReturns; ++k) found_[k] = {INFINITY, 0};
        start_layer();
    }
    // Adds the next contribution. `transmittance` is the light in front of it.
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
    // A place on the ray, and the weight of the layer up to it.
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
        if (size_ == kMostMedians) return;  // impossible; the memory ends here
        medians_[(first_ + size_) % kMostMedians] = median;
        ++size_;
    }
    // Drops the places before which less than `half` has passed.
    V3DG_HD void drop_up_to(float half) {
        while (size_ > 0 && medians_[first_].passed < half) {
            first_ = first_ + 1 == kMostMedians ? 0 : first_ + 1;
            --size_;
        }
    }
    V3DG_HD void end_layer() {
        drop_up_to(0.5f * weight_);
        found_[num_found_] = {size_ > 0 ? medians_[first_].range : last_range_, intensity_};
        ++num_found_;
        start_layer();
    }

    ReturnRule rule_;
    Return found_[kMostReturns];
    int num_found_;
    bool is_detected_;
    float weight_, intensity_, most_half_, last_range_, end_;
    uint32_t first_, size_;
    Median medians_[kMostMedians];
};

}  // namespace v3dg
