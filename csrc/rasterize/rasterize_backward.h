#pragma once

// Backward pass of rasterization on CUDA, of one picture: from the picture's gradients to those of
// its records.

#include "base/device.h"
#include "frame/gradient_slots.h"
#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// A picture as it was drawn, the lists it was blended from, and its gradients, all on the device.
struct RasterizeBackwardInput {
    FrameImage image;
    RecordPlanes records;
    const unsigned long long* tile_first;  // [num_tiles + 1] into order
    const uint32_t* order;                 // each tile's records front to back
    const uint32_t* blended;  // [num_tiles] of them, those in front of where all pixels had stopped
    const TilePlan* plans;    // [num_tiles] in the order in which blocks take the tiles
    PictureGradient<float> d_picture;
};

// Writes the slots and the gradient of the background (3). `d_background_of_tile` is scratch,
// (num_tiles, 3).
void rasterize_backward(const RasterizeBackwardInput& in, const GradientSlots& slots,
                        float* d_background_of_tile, float* d_background, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
