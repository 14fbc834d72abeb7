#pragma once

// Projection on CUDA: the interface. project() projects all items of a frame at once;
// pack() and pack_pages() prepare gaussians for it.

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

// The gaussians of a frame. Either `models` holds all models as rows; or each model is
// in `packed` or in `coded`, and empty in the other list. An unused list is null.
struct ProjectInput {
    const GaussianRows<const float>* models;
    const PackedPlanes* packed;
    const CodedGaussians* coded;
    const Placement* placements;
    const FrameImage* images;
    // The kernel adds to the counters in_frustum, records and large, which start at 0.
    ItemList items;
    bool has_shared_items;  // whether any item may be shared by several placements
    // Whether any item may have a weight below 1. Such items are not shared.
    bool has_faded_items;
    bool has_lenses;  // whether the camera of any image is not a pinhole
    // Opacity and colour factors of the instances; null if all are 1. Placement p has
    // the factors at index p modulo num_factors.
    const InstanceFactors* factors;
    uint32_t num_factors;
    // [images] counts to which the kernel adds; null if not requested
    ImageCounts* image_counts;

    // Returns the factors of an item's first placement. In a shared item, the factors
    // of the next placements follow. Precondition: `factors` is not null.
    V3DG_HD const InstanceFactors* factors_of(const DrawItem& item) const {
        return factors + item.placement % num_factors;
    }
};

struct ProjectOutput {
    RecordPlanes records;
    FewTiles* few;           // tiles of each small record (see TileBinInput)
    uint32_t* item_records;  // [items] number of records of each item
    ItemTiles* item_tiles;   // [items] the tiles of each item
    // The index of each record's gaussian in its model. For a record of a shared item:
    // 32 times the index of the gaussian in the item, plus the index of the placement
    // among the sharers. Null if records.box is null.
    uint32_t* source;
    TileCounts tiles;
    LargeRecord* large;
    unsigned long long large_capacity;
    // Work counters, initially 0: how many items warps have claimed beyond their first
    // one. [0] is for rows and packed models, [1] for coded models.
    unsigned* taken;
};

// Projects all items of a frame like v3dg::project(). Writes a record for each gaussian
// that reaches a pixel centre, in the order of the items, and adds it to the counts of
// the tiles that it touches. Does nothing if the items exceed a capacity.
void project(const ProjectInput& in, const ProjectOutput& out, cudaStream_t stream);

// Packs the rows of a model into `planes`, which has room for (4, N, 4) floats.
PackedPlanes pack(const GaussianRows<const float>& rows, float* planes, cudaStream_t stream);

// One page to pack: its gaussians on the device, and its first row in the planes.
struct PageRows {
    GaussianRows<const float> rows;  // aligned to 4 bytes only
    // The codes of a coded page; else empty. For a coded page, only size and degree of
    // `rows` are set.
    PageCodes<const uint32_t> codes;
    size_t first_row;
};
// Packs pages into planes (4, num_rows, 4). If `sh` is not null, writes the SH
// coefficients there, in rows of `sh_stride` floats. `pages` must be readable by the
// device.
void pack_pages(const PageRows* pages, size_t num_pages, float* planes, size_t num_rows, float* sh,
                int sh_stride, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
