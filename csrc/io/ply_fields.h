#pragma once

// The mapping from the numbers in a row of a .ply file to a gaussian, and their
// conversion.

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <vector>

#include "io/ply.h"

namespace v3dg {

// Bytes that all threads convert together if a single thread has to separate the rows.
constexpr size_t kPlyChunkBytes = size_t(1) << 22;

// The slots of a gaussian, in the order of its numbers; from kSh on in the order of
// memory.
enum PlySlot : size_t { kMean = 0, kQuat = 3, kScale = 7, kOpacity = 10, kSh = 11 };

// The position in a row of the number for a slot.
struct PlyField {
    size_t property;  // index among the properties of the vertex element
    size_t offset;    // bytes from the start of the row, without lists
    PlyType type;
};

// Returns K of the vertex element. Throws PlyError.
size_t num_sh_of(const PlyElement& vertex);

// Returns [kSh + 3 * K] the field of each slot. Throws PlyError if a property is
// missing, occurs twice or is a list.
std::vector<PlyField> fields_of(const PlyElement& vertex, size_t num_sh);

// The smallest number whose square a double represents with full precision.
constexpr double kLeastSquared = 1e-140;
constexpr double kMostSquared = 1e140;

// For squared lengths: that of a rounded unit quaternion differs from 1 by 3e-7.
constexpr double kUnitTolerance = 1e-6;

// Multiplies a quaternion by a power of two if doubles cannot represent its squares.
// Quaternions that are zero or not finite stay unchanged.
inline void scale_extreme(double quat[4]) {
    double largest = 0;
    for (size_t j = 0; j < 4; ++j) largest = std::max(largest, std::abs(quat[j]));
    const bool is_usual = largest > kLeastSquared && largest < kMostSquared;
    if (is_usual || largest == 0 || !std::isfinite(largest)) return;
    const int exponent = std::ilogb(largest);
    for (size_t j = 0; j < 4; ++j) quat[j] = std::ldexp(quat[j], -exponent);
}

// Converts and stores gaussian i; load(slot) returns the number in the file for a slot.
template <class Load>
void store_gaussian(const Load& load, size_t i, size_t num_sh, const PlyGaussians<float>& out) {
    for (size_t j = 0; j < 3; ++j) out.means[3 * i + j] = static_cast<float>(load(kMean + j));
    for (size_t j = 0; j < 3; ++j)
        out.scales[3 * i + j] = static_cast<float>(std::exp(double(load(kScale + j))));
    out.opacities[i] = static_cast<float>(1 / (1 + std::exp(-double(load(kOpacity)))));
    float* sh = out.sh.data + 3 * num_sh * i;
    for (size_t j = 0; j < 3 * num_sh; ++j) sh[j] = static_cast<float>(load(kSh + j));

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
