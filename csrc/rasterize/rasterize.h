#pragma once

// Blends the lists of tiles into pictures, front to back, and computes the gradients of
// records.

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

// Blends the sorted entries of one tile, front to back. Writes the tile's pixels that
// are inside the picture's window. (left, top) is the tile's first pixel.
V3DG_DECLARE_PER_ISA(template <class T>
                     void rasterize_tile(const Record<T>* records, EntryFormat format,
                                         const uint64_t* entry, size_t count, int left, int top,
                                         const Picture<T>& picture))

// Computes the gradients of a tile's sorted entries, and writes them in the same order.
// If `size` is not null, also computes the absolute gradients of their centres. The
// caller must clear `d_entry` and `size`. Adds the gradient of the background (3) to
// `d_background`.
V3DG_DECLARE_PER_ISA(template <class T> void rasterize_tile_backward(
    const Record<T>* records, EntryFormat format, const uint64_t* entry, size_t count, int left,
    int top, const Picture<T>& picture, const PictureGradient<T>& d_picture,
    RecordGradient<T>* d_entry, CenterSize<T>* size, T* d_background))

namespace cuda {

// The results of the forward pass that the backward pass needs, in device memory.
struct RasterTape {
    // The records of each tile in blending order. Records that could not change any
    // pixel are omitted. The array is as long as the array of entries, and the records
    // of tile t start at tile_first[t].
    uint32_t* order;
    // [num_tiles] number of records of each tile in `order`
    uint32_t* blended;
};

// Returns the number of plans to allocate if tiles may be blended in parts. With a
// tape, a tile has exactly one plan.
uint32_t most_plans(uint32_t num_tiles);

// Blends the list of each tile into the pictures of lists.images, and writes every
// pixel. The entries of a list may be in any order. Overwrites lists.entries and
// lists.scratch. If a counter exceeds its capacity, does nothing. `tape` may be null.
void rasterize(const FrameLists& lists, const RasterTape* tape, Stream stream);

// The inputs of the backward pass in device memory: the pictures, the lists that they
// were blended from, and the gradients of the pictures.
struct RasterizeBackwardInput {
    FrameImage image;  // the single picture; not used with a PictureBatch
    RecordPlanes records;
    // [num_tiles + 1] first element of each tile in `order`
    const unsigned long long* tile_first;
    const uint32_t* order;  // records of each tile, front to back
    // [num_tiles] number of records in `order` that were processed before all pixels
    // stopped
    const uint32_t* blended;
    const TilePlan* plans;  // [num_tiles] in the order in which tiles are processed
    // The gradient of the single picture. Not used with a PictureBatch.
    PictureGradient<float> d_picture;
};

// Pictures that are differentiated together.
struct PictureBatch {
    const FrameImage* images;
    const PictureGradient<float>* d_pictures;
    uint32_t num_tiles;       // total over all pictures
    bool has_depth = false;   // whether every gradient includes depth; otherwise, none
                              // does
    uint32_t num_images = 0;  // number of pictures of equal size; only needed for
                              // gradients of backgrounds
};

// Computes the gradients of the slots and of the background (3) of a single picture.
// `d_background_of_tile` is scratch memory, (num_tiles, 3).
void rasterize_backward(const RasterizeBackwardInput& in, const GradientSlots& slots,
                        float* d_background_of_tile, float* d_background, Stream stream);
// Computes the gradients of the slots of all pictures of a batch. Also computes the
// gradients of the backgrounds (num_images, 3), unless that pointer is null. Ignores
// the single picture and gradient of `in`. `d_background_of_tile` is scratch memory,
// (num_tiles, 3), or null.
void rasterize_backward(const RasterizeBackwardInput& in, const PictureBatch& batch,
                        const GradientSlots& slots, float* d_background_of_tile,
                        float* d_background, Stream stream);

}  // namespace cuda

}  // namespace v3dg
