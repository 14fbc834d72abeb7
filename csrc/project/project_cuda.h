#pragma once

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/tile_list.h"
#include "quantize/quantize.h"

namespace v3dg {
namespace cuda {

// Gaussians that stay as codes.
struct CodedGaussians {
    Codes codes;
    Palette palette;
};

// Models are rows, or of each one is either packed or coded, and not there in the other list. A
// list that would have none is null.
struct ProjectInput {
    const GaussianRows<const float>* models;
    const PackedPlanes* packed;
    const CodedGaussians* coded;
    const Placement* placements;
    const FrameImage* images;
    ItemList items;         // in the counters: sets in_frustum, records and large, which start at 0
    bool has_shared_items;  // whether there may be any
    bool has_faded_items;   // the same; these are of scenes and not shared
};

struct ProjectOutput {
    RecordPlanes records;
    FewTiles* few;           // of each record, as TileBinInput has it
    uint32_t* item_records;  // [items] how many of an item's gaussians became records
    ItemTiles* item_tiles;   // [items]
    uint32_t*
        source;  // of each record, its gaussian's place in the model; null without records.box
    TileCounts tiles;
    LargeRecord* large;
    unsigned long long large_capacity;
    unsigned*
        taken;  // [2] items beyond the first of each warp, of coded models in the second; 0 before
};

// As v3dg::project, for all items of a frame: writes a record, in the items' order, for each
// gaussian that reaches a pixel centre, and counts into the tiles that it touches. Does nothing
// when the items are over a capacity.
void project(const ProjectInput& in, const ProjectOutput& out, cudaStream_t stream);

// `planes` has room for (4, N, 4).
PackedPlanes pack(const GaussianRows<const float>& rows, float* planes, cudaStream_t stream);

// The gaussians of a page on the device, and where they go.
struct PageRows {
    GaussianRows<const float> rows;  // at any multiple of 4 bytes
    PageCodes<const uint32_t>
        codes;  // where they are coded; then `rows` has their number and degree alone
    size_t first_row;
};
// The same for pages, into planes (4, num_rows, 4) and, where they have any, SH coefficients into
// rows of `sh_stride` floats. `pages` is memory that the device can read.
void pack_pages(const PageRows* pages, size_t num_pages, float* planes, size_t num_rows, float* sh,
                int sh_stride, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
