#pragma once

// Loads and stores records in kernels. A record consists of vectors of 16 bytes. Half
// of the last vector is unused.

#include <cstddef>

#include "base/device.h"
#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

constexpr int kRecordVectors = 3;
constexpr int kEllipseVectors = 2;  // vectors per record in RecordPlanes::ellipse
static_assert(sizeof(Record<float>) == kRecordVectors * sizeof(float4) &&
                  offsetof(Record<float>, l22) == 16 && offsetof(Record<float>, color) == 24 &&
                  offsetof(Record<float>, depth) == 36 && offsetof(Record<float>, x0) == 40,
              "record_of_vectors() requires this layout of a record");

__device__ inline const float4* ellipse_of(const RecordPlanes& records, uint32_t record) {
    return reinterpret_cast<const float4*>(records.ellipse) + kEllipseVectors * size_t(record);
}
__device__ inline const float2* rest_of(const RecordPlanes& records, uint32_t record) {
    return reinterpret_cast<const float2*>(records.rest) + record;
}

__device__ inline Record<float> record_of_vectors(const float4& a, const float4& b, const float2& c,
                                                  const RecordBox& box) {
    return {.u = a.x,
            .v = a.y,
            .l11 = a.z,
            .l12 = a.w,
            .l22 = b.x,
            .log2_opacity = b.y,
            .color = {b.z, b.w, c.x},
            .depth = c.y,
            .x0 = box.x0,
            .x1 = box.x1,
            .y0 = box.y0,
            .y1 = box.y1};
}

// Loads a record. The compiler omits loads of fields that are not used.
__device__ inline Record<float> load_record(const RecordPlanes& records, uint32_t record,
                                            const RecordBox& box) {
    const float4* ellipse = ellipse_of(records, record);
    return record_of_vectors(ellipse[0], ellipse[1], *rest_of(records, record), box);
}

}  // namespace cuda
}  // namespace v3dg
