#include "cluster/examine.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "base/parallel_for.h"

namespace v3dg {

namespace {

constexpr size_t kGaussiansAtOnce = 4096;

bool are_finite(const float* values, size_t count) {
    // The loop counts without an early exit, so that it is vectorised.
    size_t num_finite = 0;
    for (size_t k = 0; k < count; ++k)
        num_finite += std::abs(values[k]) <= std::numeric_limits<float>::max() ? 1 : 0;
    return num_finite == count;
}

bool is_too_large(float value) { return std::isfinite(value) && std::abs(value) > kMostLength; }

uint16_t findings_of(const GaussianRows<const float>& in, size_t row) {
    const float *mean = in.means + 3 * row, *scale = in.scales + 3 * row;
    const float opacity = in.opacities[row];
    uint16_t found = 0;
    const auto note = [&](bool holds, Finding finding) {
        if (holds) found |= finding;
    };
    note(!are_finite(mean, 3), kMeanNotFinite);
    note(!are_finite(in.quats + 4 * row, 4), kQuatNotFinite);
    note(!are_finite(scale, 3), kScaleNotFinite);
    note(!std::isfinite(opacity), kOpacityNotFinite);
    note(!are_finite(in.sh + in.num_sh() * row, in.num_sh()), kShNotFinite);
    note(std::any_of(mean, mean + 3, is_too_large) || std::any_of(scale, scale + 3, is_too_large),
         kTooLarge);
    note(std::any_of(scale, scale + 3, [](float value) { return value < 0; }), kNegativeScale);
    note(opacity < 0 || (opacity > 1 && std::isfinite(opacity)), kOpacityOutOfRange);
    note(opacity >= 0 && opacity < static_cast<float>(kMinAlpha), kTransparent);
    return found;
}

}  // namespace

void examine(const GaussianRows<const float>& in, Span<uint16_t> findings) {
    parallel_for(in.size, kGaussiansAtOnce,
                 [&](size_t row) { findings[row] = findings_of(in, row); });
}

}  // namespace v3dg
