#pragma once

// The way back through a CUDA frame of one picture: from the picture's gradients to those of its records.

#include "base/device.h"
#include "pipeline/frame_types.h"
#include "rasterize/rasterize.h"

namespace v3dg {
namespace cuda {

// A record's gradient is the sum of its slots, one for each tile of its pixel box, row by row. A tile writes
// the slots of the records that it blended and marks them as touched; the others mean nothing.
struct GradientSlots {
    const uint32_t* first;  // of each record
    RecordGradient<float>* slot;
    uint8_t* is_touched;  // zeros at the start
};

V3DG_HD inline uint32_t tile_columns_of(const Record<float>& r) {
    return r.x1 / kFrameTileWidth - r.x0 / kFrameTileWidth + 1u;
}
V3DG_HD inline uint32_t num_slots_of(const Record<float>& r) {
    return tile_columns_of(r) * (r.y1 / kFrameTileHeight - r.y0 / kFrameTileHeight + 1u);
}
V3DG_HD inline uint32_t slot_of_tile(const Record<float>& r, uint32_t column, uint32_t row) {
    return (row - r.y0 / kFrameTileHeight) * tile_columns_of(r) + (column - r.x0 / kFrameTileWidth);
}

// A picture as it was drawn, the lists it was blended from, and its gradients, all on the device.
struct RasterizeBackwardInput {
    FrameImage image;
    const Record<float>* records;
    const unsigned long long* tile_first;  // [num_tiles + 1] into order
    const uint32_t* order;                 // each tile's records front to back
    const uint32_t* blended;  // [num_tiles] of them, those in front of where all pixels had stopped
    const TilePlan* plans;    // [num_tiles] in the order in which blocks take the tiles
    PictureGradient<float> d_picture;
};

// Writes the slots and the gradient of the background (3). `d_background_of_tile` is scratch, (num_tiles, 3).
void rasterize_backward(const RasterizeBackwardInput& in, const GradientSlots& slots,
                        float* d_background_of_tile, float* d_background, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
