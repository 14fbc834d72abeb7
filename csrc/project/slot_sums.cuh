#pragma once

// Device functions of the backward pass of projection: sums of gradient slots, and rows
// of gaussians.

#include "base/launch.cuh"
#include "frame/gradient_slots.h"

namespace v3dg {
namespace cuda {

// One thread sums up to this many slots of a record. If there are more, a warp sums
// them.
constexpr uint32_t kFewSlots = 16;

template <class Value>
__device__ void add_slot(const Value* of_slot, uint32_t i, Value& sum) {
    static_assert(sizeof sum % sizeof(float2) == 0, "values are loaded as pairs of floats");
    Value slot;
    for (size_t k = 0; k < sizeof sum / sizeof(float2); ++k)
        reinterpret_cast<float2*>(&slot)[k] = reinterpret_cast<const float2*>(of_slot + i)[k];
    sum += slot;
}

// Sums `num` slots in a fixed order, so that the bits of the result are reproducible.
// Returns whether any slot was written. All lanes of the warp must call it.
template <class Value>
__device__ bool sum_of_slots(const GradientSlots& slots, const Value* of_slot, uint32_t first,
                             uint32_t num, Value& sum) {
    const int lane = threadIdx.x % 32;
    uint32_t touched = 0;
    if (num <= kFewSlots) {
        for (uint32_t i = 0; i < num; ++i)
            touched |= static_cast<uint32_t>(slots.is_touched[first + i]) << i;
        for (uint32_t todo = touched; todo != 0; todo &= todo - 1)
            add_slot(of_slot, first + __ffs(todo) - 1, sum);
    }
    for (unsigned many = __ballot_sync(kAllLanes, num > kFewSlots); many != 0; many &= many - 1) {
        const int owner = __ffs(many) - 1;
        const uint32_t begin = __shfl_sync(kAllLanes, first, owner),
                       end = begin + __shfl_sync(kAllLanes, num, owner);
        Value part{};
        bool part_touched = false;
        for (uint32_t i = begin + lane; i < end; i += 32)
            if (slots.is_touched[i] != 0) {
                add_slot(of_slot, i, part);
                part_touched = true;
            }
        float* value = reinterpret_cast<float*>(&part);
        for (size_t k = 0; k < sizeof part / sizeof(float); ++k) value[k] = warp_sum(value[k]);
        part_touched = __any_sync(kAllLanes, part_touched) != 0;
        if (lane == owner) {
            sum = part;
            touched = part_touched;
        }
    }
    return touched != 0;
}

template <int kWidth>
__device__ void load_row(const float* rows, uint64_t i, float (&row)[kWidth]) {
#pragma unroll
    for (int k = 0; k < kWidth; ++k) row[k] = rows[kWidth * i + k];
}
template <int kWidth>
__device__ void store_row(float* rows, uint64_t i, const float* row) {
#pragma unroll
    for (int k = 0; k < kWidth; ++k) rows[kWidth * i + k] = row[k];
}

}  // namespace cuda
}  // namespace v3dg
