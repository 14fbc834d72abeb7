#pragma once

// The slots in which a CUDA frame sums the gradients of its records: one for each tile
// that a record meets.

#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// The gradient of a record is the sum of its slots, one for each tile of its pixel box,
// row by row. A tile writes the slots of the records that it blended and marks them as
// touched; the contents of other slots are undefined.
struct GradientSlots {
    const uint32_t* first;  // first slot of each record
    RecordGradient<float>* slot;
    CenterSize<float>* size;  // sizes of each slot; null if not requested
    uint8_t* is_touched;      // initially zero
};

V3DG_HD inline uint32_t slot_of_tile(const RecordBox& r, uint32_t column, uint32_t row) {
    return (row - r.y0 / kFrameTileHeight) * tile_columns_of(r) + (column - r.x0 / kFrameTileWidth);
}

}  // namespace cuda
}  // namespace v3dg
