#pragma once

// The bits of floats as numbers that ascend as the floats do, for sorting and
// selecting.

#include <cstdint>

namespace v3dg {
namespace cuda {

// Returns bits that ascend as unsigned numbers as the finite values do. -0 counts as 0,
// as it does in comparisons.
__device__ inline uint32_t ascending_bits(float value) {
    const uint32_t bits = __float_as_uint(value + 0.0f);
    return bits ^ (bits >> 31 ? 0xffffffffu : 0x80000000u);
}

// Returns the value that has these ascending bits.
__device__ inline float value_of_bits(uint32_t ascending) {
    return __uint_as_float(ascending ^ (ascending >> 31 ? 0x80000000u : 0xffffffffu));
}

}  // namespace cuda
}  // namespace v3dg
