#pragma once

// Projection on CUDA. project() projects all items of a frame at once. pack() and
// pack_pages() prepare gaussians for it.

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/tile_list.h"
#include "math/instance_factors.h"
#include "quantize/quantize.h"

namespace v3dg {
namespace cuda {

// Gaussians of a model as codes.
struct CodedGaussians {
    Codes codes;
    Palette palette;
};

// The gaussians of a frame. If `models` is not null, it has all models as rows.
// Otherwise, each model is in `packed` or in `coded`, and its element in the other list
// is empty. A list that no model uses is null.
struct ProjectInput {
    const GaussianRows<const float>* models;
    const PackedPlanes* packed;
    const CodedGaussians* coded;
    const Placement* placements;
    const FrameImage* images;
    // The kernel adds to the counters in_frustum, records and large, which must start
    // at 0.
    ItemList items;
    bool has_shared_items;  // whether any item may be shared by several placements
    // Whether any item may have a weight below 1. Such items are not shared.
    bool has_faded_items;
    bool has_lenses;  // whether any image's camera is not a pinhole camera
    // Factors of opacities and colours of the instances; null if all are 1. Placement p
    // has the factors at index p modulo num_factors.
    const InstanceFactors* factors;
    uint32_t num_factors;
    // [images] the kernel adds to these counts; null if not requested
    ImageCounts* image_counts;

    // Returns the factors of an item's first placement. In a shared item, those of its
    // other placements follow. Precondition: `factors` is not null.
    V3DG_HD const InstanceFactors* factors_of(const DrawItem& item) const {
        return factors + item.placement % num_factors;
    }
};

struct ProjectOutput {
    RecordPlanes records;
    FewTiles* few;           // tiles of each small record (see TileBinInput)
    uint32_t* item_records;  // [items] number of records of each item
    ItemTiles* item_tiles;   // [items] the tiles of each item
    // The index of each record's gaussian in its model. For a record of a shared item,
    // it is 32 times the index of the gaussian in the item, plus the index of the
    // placement among the sharers. Null if records.box is null.
    uint32_t* source;
    TileCounts tiles;
    LargeRecord* large;
    unsigned long long large_capacity;
    // Work counters, initially 0. They count the items that warps have claimed in
    // addition to their first one: [0] for rows and packed models, [1] for coded
    // models.
    unsigned* taken;
};

// Projects all items of a frame with the rules of v3dg::project(). For each gaussian
// that reaches a pixel centre, it writes a record, in the order of the items, and
// counts the tiles that the record touches. Does nothing if the number of items exceeds
// a capacity.
void project(const ProjectInput& in, const ProjectOutput& out, cudaStream_t stream);

// Packs the rows of a model into `planes`, which must have room for (4, N, 4) floats.
PackedPlanes pack(const GaussianRows<const float>& rows, float* planes, cudaStream_t stream);

// One page to pack: its gaussians on the device, and its first row in the planes.
struct PageRows {
    GaussianRows<const float> rows;  // only aligned to 4 bytes
    // The codes of a coded page; empty for other pages. For a coded page, only the size
    // and the degree of `rows` are set.
    PageCodes<const uint32_t> codes;
    size_t first_row;
};
// Packs pages into planes (4, num_rows, 4). If `sh` is not null, writes the SH
// coefficients to it, in rows of `sh_stride` floats. The device must be able to read
// `pages`.
void pack_pages(const PageRows* pages, size_t num_pages, float* planes, size_t num_rows, float* sh,
                int sh_stride, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
