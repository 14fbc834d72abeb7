#pragma once

// The backward pass of projection on CUDA, for a frame that shows one model in one
// picture or in several. It computes the gradients of the model's gaussians from those
// of the records.

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/gradient_slots.h"

namespace v3dg {
namespace cuda {

// Assigns gradient slots to the records of a frame. The slots of record r begin at
// first_slot[r]. Adds the number of slots to the counters. Does nothing if the number
// of items exceeds a capacity.
void place_slots(const ItemList& items, const uint32_t* item_records, const RecordBox* boxes,
                 uint32_t* first_slot, cudaStream_t stream);

struct ProjectBackwardInput {
    // Item i consists of the kItemSize gaussians that begin at i * kItemSize; the last
    // item may be shorter. The records of item i begin at i * kItemSize, in the order
    // of the gaussians.
    const uint32_t* item_records;  // number of records of each item
    RecordPlanes records;
    const uint32_t* source;  // index of each record's gaussian
    GaussianRows<const float> rows;
    ModelView<float> view;     // of the single picture; not used with an ItemBatch
    Intrinsics<float> camera;  // of the single picture; not used with an ItemBatch
    float filter_px2;
    bool antialiased;
    bool has_lenses;  // whether any picture's camera is not a pinhole camera
};
// The items of several pictures of one model. An item has at most kItemSize gaussians.
// The records of item i begin at i * kItemSize.
struct ItemBatch {
    const DrawItem* items;
    unsigned num_items;
    const Placement* placements;
    const FrameImage* images;
    uint64_t first_wanted;  // items that begin before this gaussian get no gradients
};

// Writes the gradients of every gaussian; they are zero for a gaussian without a
// record. The SH gradients must be aligned to 16 bytes, like the SH coefficients. If
// `centers` has sizes, `slots` must have sizes.
void project_backward(const ProjectBackwardInput& in, const GradientSlots& slots,
                      const GaussianRows<float>& out, const CenterGradients<float>& centers,
                      cudaStream_t stream);
// Writes the gradients of the gaussians of a batch's items. Item i writes to the rows
// of `out` that begin at i * kItemSize; they are zero for a gaussian without a record.
// Items before `first_wanted` are skipped. The view and the camera of `in` are ignored.
void project_backward(const ProjectBackwardInput& in, const ItemBatch& batch,
                      const GradientSlots& slots, const GaussianRows<float>& out,
                      cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
