#pragma once

#include "base/device.h"
#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// What the backward pass needs of the forward pass; every pointer is on the device.
struct RasterTape {
    // As long as the entries, each tile's at its tile_first: its records in the order they were
    // blended, without those that could change no pixel.
    uint32_t* order;
    // [num_tiles] How many entries of `order` were written.
    uint32_t* blended;
};

// Plans that blending in parts takes at most. A frame with a tape has one for each tile.
uint32_t most_plans(uint32_t num_tiles);

// Blends each tile's list into the pictures that lists.images name; every pixel is written.
// Overwrites lists.entries and lists.scratch. Does nothing where the counters are over a capacity.
// The result does not depend on the order of the entries within a tile's list. `tape` may be null.
void rasterize(const FrameLists& lists, const RasterTape* tape, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
