#pragma once

// Convert floats to integers of the same order, and back, for sorting and selecting.

#include <cstdint>

namespace v3dg {
namespace cuda {

// Converts a finite float to an unsigned integer, such that integers have the same
// order as the floats. -0 and 0 give the same integer.
__device__ inline uint32_t ascending_bits(float value) {
    const uint32_t bits = __float_as_uint(value + 0.0f);
    return bits ^ (bits >> 31 ? 0xffffffffu : 0x80000000u);
}

// Converts an integer from ascending_bits() back to the float.
__device__ inline float value_of_bits(uint32_t ascending) {
    return __uint_as_float(ascending ^ (ascending >> 31 ? 0x80000000u : 0xffffffffu));
}

}  // namespace cuda
}  // namespace v3dg
