#pragma once

// A record as kernels load and store it: three vectors of 16 bytes.

#include <cstddef>

#include "base/device.h"
#include "frame/record.h"

namespace v3dg {
namespace cuda {

constexpr int kRecordVectors = 3;
static_assert(sizeof(Record<float>) == kRecordVectors * sizeof(float4) &&
                  offsetof(Record<float>, l22) == 16 && offsetof(Record<float>, color) == 24 &&
                  offsetof(Record<float>, depth) == 36 && offsetof(Record<float>, x0) == 40,
              "a record lies in its vectors as record_of_vectors() has it");

__device__ inline Record<float> record_of_vectors(const float4& a, const float4& b, const float4& c) {
    const uint32_t columns = __float_as_uint(c.z), rows = __float_as_uint(c.w);
    return {a.x,
            a.y,
            a.z,
            a.w,
            b.x,
            b.y,
            {b.z, b.w, c.x},
            c.y,
            static_cast<uint16_t>(columns),
            static_cast<uint16_t>(columns >> 16),
            static_cast<uint16_t>(rows),
            static_cast<uint16_t>(rows >> 16)};
}

// Loads of the vectors what the caller uses.
__device__ inline Record<float> load_record(const Record<float>* record) {
    const float4* vectors = reinterpret_cast<const float4*>(record);
    return record_of_vectors(vectors[0], vectors[1], vectors[2]);
}

__device__ inline void store_record(const Record<float>& r, float4* vectors) {
    vectors[0] = {r.u, r.v, r.l11, r.l12};
    vectors[1] = {r.l22, r.log2_opacity, r.color[0], r.color[1]};
    vectors[2] = {r.color[2], r.depth, __uint_as_float(r.x0 | uint32_t(r.x1) << 16),
                  __uint_as_float(r.y0 | uint32_t(r.y1) << 16)};
}

}  // namespace cuda
}  // namespace v3dg
