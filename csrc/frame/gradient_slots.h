#pragma once

// The memory in which a CUDA frame collects the gradients of its records, one slot per
// record and tile.

#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// Gradient slots. Each record has one slot for each tile of its pixel box, row by row.
// The gradient of a record is the sum of its slots. A tile writes the slots of the
// records that it blended, and marks them as touched. All other slots are undefined.
struct GradientSlots {
    const uint32_t* first;  // index of each record's first slot
    RecordGradient<float>* slot;
    CenterSize<float>* size;  // absolute gradients of centres; null if not requested
    uint8_t* is_touched;      // one per slot, initially zero
};

V3DG_HD inline uint32_t slot_of_tile(const RecordBox& r, uint32_t column, uint32_t row) {
    return (row - r.y0 / kFrameTileHeight) * tile_columns_of(r) + (column - r.x0 / kFrameTileWidth);
}

}  // namespace cuda
}  // namespace v3dg
