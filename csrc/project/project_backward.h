#pragma once

// The backward pass of projection on CUDA. The input is the gradients of the records of
// a frame that shows one model, in one picture or in several. The output is the
// gradients of the model's gaussians.

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/gradient_slots.h"

namespace v3dg {
namespace cuda {

// Assigns gradient slots to the records of a frame: the slots of record r begin at
// first_slot[r]. Adds the number of slots to the counters. Does nothing if the items
// exceed a capacity.
void place_slots(const ItemList& items, const uint32_t* item_records, const RecordBox* boxes,
                 uint32_t* first_slot, cudaStream_t stream);

struct ProjectBackwardInput {
    // Item i consists of the kItemSize gaussians from i * kItemSize on; the last item
    // may be shorter. The records of item i begin at i * kItemSize, in the order of the
    // gaussians.
    const uint32_t* item_records;  // number of records of each item
    RecordPlanes records;
    const uint32_t* source;  // index of each record's gaussian
    GaussianRows<const float> rows;
    ModelView<float> view;     // of the only picture; unused with an ItemBatch
    Intrinsics<float> camera;  // of the only picture; unused with an ItemBatch
    float filter_px2;
    bool antialiased;
    bool has_lenses;  // whether the camera of any picture is no pinhole
};
// The items of several pictures of one model. An item has at most kItemSize gaussians.
// The records of item i begin at i * kItemSize.
struct ItemBatch {
    const DrawItem* items;
    unsigned num_items;
    const Placement* placements;
    const FrameImage* images;
    uint64_t first_wanted;  // no gradients for items that begin before this gaussian
};

// Writes the gradients of every gaussian; zeros for a gaussian without a record. The SH
// gradients must be aligned to 16 bytes, like the SH coefficients. If `centers` has
// sizes, `slots` must have sizes.
void project_backward(const ProjectBackwardInput& in, const GradientSlots& slots,
                      const GaussianRows<float>& out, const CenterGradients<float>& centers,
                      cudaStream_t stream);
// Writes the gradients of the gaussians of a batch's items. Item i writes to the rows
// of `out` from i * kItemSize on; zeros for a gaussian without a record. Skips items
// before `first_wanted`. Ignores the view and the camera of `in`.
void project_backward(const ProjectBackwardInput& in, const ItemBatch& batch,
                      const GradientSlots& slots, const GaussianRows<float>& out,
                      cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
