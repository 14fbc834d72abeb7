#pragma once

// Blends the lists of tiles into pictures, front to back, and computes the gradients of
// records from those of pictures.

#include <cstddef>
#include <cstdint>

#include "base/isa.h"
#include "base/stream.h"
#include "frame/entry.h"
#include "frame/gradient_slots.h"
#include "frame/image.h"
#include "frame/record.h"
#include "frame/tile_list.h"

namespace v3dg {

// Blends one tile's sorted entries, front to back, and writes the pixels of the tile
// that are inside the picture's window.
V3DG_DECLARE_PER_ISA(template <class T>
                     void rasterize_tile(const Record<T>* records, EntryFormat format,
                                         const uint64_t* entry, size_t count, int left, int top,
                                         const Picture<T>& picture))

// Writes the gradients of a tile's sorted entries, in their order, to `d_entry`.
// `size`, unless null, receives the sizes of the gradients with respect to the centres.
// Both must be zero on entry. Adds to `d_background` (3).
V3DG_DECLARE_PER_ISA(template <class T> void rasterize_tile_backward(
    const Record<T>* records, EntryFormat format, const uint64_t* entry, size_t count, int left,
    int top, const Picture<T>& picture, const PictureGradient<T>& d_picture,
    RecordGradient<T>* d_entry, CenterSize<T>* size, T* d_background))

namespace cuda {

// The data that the forward pass leaves for the backward pass; all pointers are to
// device memory.
struct RasterTape {
    // The records of each tile in blending order, without those that could not change
    // any pixel. The array is as long as the entries; the records of tile t begin at
    // tile_first[t].
    uint32_t* order;
    // [num_tiles] Number of elements that were written to `order` for each tile.
    uint32_t* blended;
};

// Returns the largest number of plans for blending in parts. A frame with a tape has
// one plan per tile.
uint32_t most_plans(uint32_t num_tiles);

// Blends each tile's list into the pictures of lists.images; writes every pixel.
// Overwrites lists.entries and lists.scratch. Does nothing if the counters exceed a
// capacity. The result does not depend on the order of entries in a tile's list. `tape`
// may be null.
void rasterize(const FrameLists& lists, const RasterTape* tape, Stream stream);

// Drawn pictures, the lists they were blended from, and their gradients, all on the
// device.
struct RasterizeBackwardInput {
    FrameImage image;  // of the only picture; unused where there is a batch
    RecordPlanes records;
    const unsigned long long* tile_first;  // [num_tiles + 1] indices into `order`
    const uint32_t* order;                 // records of each tile, front to back
    const uint32_t* blended;  // [num_tiles] number of them, up to where all pixels had stopped
    const TilePlan* plans;    // [num_tiles] in the order in which blocks process the tiles
    PictureGradient<float> d_picture;  // of the only picture
};

// The pictures of a batch, without depth.
struct PictureBatch {
    const FrameImage* images;
    const PictureGradient<float>* d_pictures;
    uint32_t num_tiles;  // of all pictures together
};

// Writes the slots and the gradient of the background (3) of one picture.
// `d_background_of_tile` is scratch memory, (num_tiles, 3).
void rasterize_backward(const RasterizeBackwardInput& in, const GradientSlots& slots,
                        float* d_background_of_tile, float* d_background, Stream stream);
// Writes the slots of all pictures of a batch, without sizes. The image and the
// gradient of `in` are unused.
void rasterize_backward(const RasterizeBackwardInput& in, const PictureBatch& batch,
                        const GradientSlots& slots, Stream stream);

}  // namespace cuda

}  // namespace v3dg
