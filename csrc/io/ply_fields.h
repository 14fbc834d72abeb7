#pragma once

// Maps the numbers in a row of a .ply file to a gaussian, and converts them.

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "io/ply.h"
#include "math/sh.h"

namespace v3dg {

// Number of bytes that all threads convert together, if a single thread must separate
// the rows.
constexpr size_t kPlyChunkBytes = size_t(1) << 22;

// The slots of a gaussian, which give the index of its first mean, quaternion element,
// and so on. From kSh on, slots are in the order of memory.
enum PlySlot : size_t { kMean = 0, kQuat = 3, kScale = 7, kOpacity = 10, kFilter = 11, kSh = 12 };

// Returns the layout of a vertex. Throws PlyError if a property is missing, occurs
// twice, or is a list.
PlyLayout layout_of(const PlyElement& stored);

// Limits of the numbers whose squares a double represents with full precision.
constexpr double kLeastSquared = 1e-140;
constexpr double kMostSquared = 1e140;

// The tolerance for squared lengths. Rounding a unit quaternion to float32 changes its
// squared length by up to 3e-7.
constexpr double kUnitTolerance = 1e-6;

// If the squares of a quaternion's elements are out of the range of doubles, multiplies
// the quaternion by a power of two. A quaternion that is zero or not finite is not
// changed.
inline void scale_extreme(double quat[4]) {
    double largest = 0;
    for (size_t j = 0; j < 4; ++j) largest = std::max(largest, std::abs(quat[j]));
    const bool is_usual = largest > kLeastSquared && largest < kMostSquared;
    if (is_usual || largest == 0 || !std::isfinite(largest)) return;
    const int exponent = std::ilogb(largest);
    for (size_t j = 0; j < 4; ++j) quat[j] = std::ldexp(quat[j], -exponent);
}

// Widens a gaussian along each axis by a filter of this standard deviation, and reduces
// its opacity, so that its total contribution stays the same. Source: Yu et al.,
// Mip-Splatting, CVPR 2024, equation 9.
inline void widen(double filter, size_t num_axes, double scales[3], double& opacity) {
    for (size_t j = 0; j < num_axes; ++j) {
        const double widened = std::hypot(scales[j], filter);
        if (widened > 0) opacity *= scales[j] / widened;
        scales[j] = widened;
    }
}

// Converts and stores gaussian i. load(slot) returns the number for a slot in the file.
template <class Load>
void store_gaussian(const Load& load, size_t i, const PlyLayout& layout,
                    const PlyGaussians<float>& out) {
    const size_t num_axes = layout.is_flat ? 2 : 3;
    for (size_t j = 0; j < 3; ++j) out.means[3 * i + j] = static_cast<float>(load(kMean + j));
    double scales[3] = {};
    for (size_t j = 0; j < num_axes; ++j) scales[j] = std::exp(double(load(kScale + j)));
    double opacity = 1 / (1 + std::exp(-double(load(kOpacity))));
    if (layout.has_filter) widen(load(kFilter), num_axes, scales, opacity);
    for (size_t j = 0; j < 3; ++j) out.scales[3 * i + j] = static_cast<float>(scales[j]);
    out.opacities[i] = static_cast<float>(opacity);
    float* sh = out.sh.data + 3 * layout.num_sh * i;
    for (size_t j = 0; j < 3 * layout.num_sh; ++j) sh[j] = static_cast<float>(load(kSh + j));
    for (size_t j = 0; layout.has_base_colors && j < 3; ++j)
        sh[j] = static_cast<float>((load(kSh + j) * layout.color_scale[j] - 0.5) / kShBase0);

    double quat[4];
    for (size_t j = 0; j < 4; ++j) quat[j] = load(kQuat + j);
    scale_extreme(quat);
    double norm2 = 0;
    for (const double component : quat) norm2 += component * component;
    const bool keeps_length =
        !(norm2 > 0 && std::isfinite(norm2)) || std::abs(norm2 - 1) < kUnitTolerance;
    const double factor = keeps_length ? 1 : 1 / std::sqrt(norm2);
    for (size_t j = 0; j < 4; ++j) out.quats[4 * i + j] = static_cast<float>(quat[j] * factor);
}

}  // namespace v3dg
