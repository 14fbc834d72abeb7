#pragma once

// Contract of projection on CUDA: all items of a frame at once, and packing gaussians for it.

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/tile_list.h"
#include "math/instance_factors.h"
#include "quantize/quantize.h"

namespace v3dg {
namespace cuda {

// The gaussians of a model that stays coded.
struct CodedGaussians {
    Codes codes;
    Palette palette;
};

// Models are all rows, or each is either packed or coded and absent in the other list. An empty
// list is null.
struct ProjectInput {
    const GaussianRows<const float>* models;
    const PackedPlanes* packed;
    const CodedGaussians* coded;
    const Placement* placements;
    const FrameImage* images;
    ItemList items;         // sets in_frustum, records and large of its counters, which start at 0
    bool has_shared_items;  // whether some items may be shared
    bool has_faded_items;   // whether some may have weights below 1; faded items are not shared
    // [num_factors] of the instances, of which placement p has those at p modulo num_factors; null
    // where all are 1.
    const InstanceFactors* factors;
    uint32_t num_factors;

    // Those of the first placement of an item; those of its sharers follow. Precondition: not null.
    V3DG_HD const InstanceFactors* factors_of(const DrawItem& item) const {
        return factors + item.placement % num_factors;
    }
};

struct ProjectOutput {
    RecordPlanes records;
    FewTiles* few;           // one a record, as in TileBinInput
    uint32_t* item_records;  // [items] how many of an item's gaussians became records
    ItemTiles* item_tiles;   // [items]
    // The place of each record's gaussian in the model; null without records.box.
    uint32_t* source;
    TileCounts tiles;
    LargeRecord* large;
    unsigned long long large_capacity;
    // [2] How many items warps have taken beyond their first, in the second for coded models.
    // Starts at 0.
    unsigned* taken;
};

// Projects all items of a frame as v3dg::project does: writes a record, in the items' order, for
// each gaussian that reaches a pixel centre, and counts it in the tiles that it touches. Does
// nothing when the items exceed a capacity.
void project(const ProjectInput& in, const ProjectOutput& out, cudaStream_t stream);

// Packs the rows of a model. `planes` has room for (4, N, 4).
PackedPlanes pack(const GaussianRows<const float>& rows, float* planes, cudaStream_t stream);

// The gaussians of a page on the device, and where they go.
struct PageRows {
    GaussianRows<const float> rows;  // at any multiple of 4 bytes
    // Set where they are coded; then `rows` has their number and degree alone.
    PageCodes<const uint32_t> codes;
    size_t first_row;
};
// Packs the rows of pages into planes (4, num_rows, 4) and, where they have any, SH coefficients
// into rows of `sh_stride` floats. `pages` is memory that the device can read.
void pack_pages(const PageRows* pages, size_t num_pages, float* planes, size_t num_rows, float* sh,
                int sh_stride, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
