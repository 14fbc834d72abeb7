#pragma once

// The contract of projection on CUDA: projecting all items of a frame at once, and
// packing gaussians for it.

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/tile_list.h"
#include "math/instance_factors.h"
#include "quantize/quantize.h"

namespace v3dg {
namespace cuda {

// The coded gaussians of a model.
struct CodedGaussians {
    Codes codes;
    Palette palette;
};

// Either all models are rows, or each model is packed or coded, and absent from the
// other list. An empty list is null.
struct ProjectInput {
    const GaussianRows<const float>* models;
    const PackedPlanes* packed;
    const CodedGaussians* coded;
    const Placement* placements;
    const FrameImage* images;
    ItemList items;  // the kernel sets the counters in_frustum, records and large, which start at 0
    bool has_shared_items;  // whether some items may be shared
    // Whether some items may have weights below 1; faded items are not shared.
    bool has_faded_items;
    // [num_factors] of the instances: placement p has those at p modulo num_factors.
    // Null if all factors are 1.
    const InstanceFactors* factors;
    uint32_t num_factors;
    // [images] the kernel adds to them; null if they are not requested.
    ImageCounts* image_counts;

    // Returns the factors of the first placement of an item; those of the placements
    // that share it follow. Precondition: `factors` is not null.
    V3DG_HD const InstanceFactors* factors_of(const DrawItem& item) const {
        return factors + item.placement % num_factors;
    }
};

struct ProjectOutput {
    RecordPlanes records;
    FewTiles* few;           // one per record, as in TileBinInput
    uint32_t* item_records;  // [items] number of records per item
    ItemTiles* item_tiles;   // [items]
    // The index in the model of each record's gaussian; null without records.box.
    uint32_t* source;
    TileCounts tiles;
    LargeRecord* large;
    unsigned long long large_capacity;
    // [2] Number of items that warps claimed beyond their first; the second element is
    // for coded models. Starts at 0.
    unsigned* taken;
};

// Projects all items of a frame like v3dg::project(). It writes a record, in the order
// of the items, for each gaussian that reaches a pixel centre, and counts it in the
// tiles that it touches. Does nothing if the items exceed a capacity.
void project(const ProjectInput& in, const ProjectOutput& out, cudaStream_t stream);

// Packs the rows of a model. `planes` has room for (4, N, 4).
PackedPlanes pack(const GaussianRows<const float>& rows, float* planes, cudaStream_t stream);

// The gaussians of a page on the device, and their destination.
struct PageRows {
    GaussianRows<const float> rows;  // aligned to 4 bytes only
    // Set if the page is coded; then only size and degree of `rows` are set.
    PageCodes<const uint32_t> codes;
    size_t first_row;
};
// Packs the rows of pages into planes (4, num_rows, 4) and, if present, SH coefficients
// into rows of `sh_stride` floats. `pages` is in memory that the device can read.
void pack_pages(const PageRows* pages, size_t num_pages, float* planes, size_t num_rows, float* sh,
                int sh_stride, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
