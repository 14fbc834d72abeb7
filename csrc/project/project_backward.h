#pragma once

// Backward pass of projection on CUDA. The input are the gradients of the records of a
// frame that shows one model, in one picture or in several; the output are the
// gradients of the model's gaussians.

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/gradient_slots.h"

namespace v3dg {
namespace cuda {

// Assigns gradient slots to each record of a frame, beginning at the record's
// `first_slot`, and counts all slots in the counters. Does nothing if the items exceed
// a capacity.
void place_slots(const ItemList& items, const uint32_t* item_records, const RecordBox* boxes,
                 uint32_t* first_slot, cudaStream_t stream);

struct ProjectBackwardInput {
    // Items have kItemSize gaussians, except for the last one. The records of item i
    // are contiguous from i * kItemSize on, in the order of their gaussians.
    const uint32_t* item_records;  // number of records per item
    RecordPlanes records;
    const uint32_t* source;  // gaussian of each record
    GaussianRows<const float> rows;
    ModelView<float> view;     // of the only picture; unused where there is a batch
    Intrinsics<float> camera;  // of the only picture
    float filter_px2;
    bool antialiased;
};
// The items of a batch of pictures. Item i has any gaussians of the model, at most
// kItemSize, and its records are consecutive from i * kItemSize on.
struct ItemBatch {
    const DrawItem* items;
    unsigned num_items;
    const Placement* placements;
    const FrameImage* images;
    uint64_t first_wanted;  // items that begin before this gaussian have no gradients
};

// Writes the gradients of every gaussian, zeros for those without a record. The
// gradients of SH coefficients begin at a multiple of 16 bytes, as the coefficients do.
// The slots contain sizes if `centers` does.
void project_backward(const ProjectBackwardInput& in, const GradientSlots& slots,
                      const GaussianRows<float>& out, const CenterGradients<float>& centers,
                      cudaStream_t stream);
// Writes the gradients of the gaussians of each wanted item of a batch to the rows of
// `out` from kItemSize * item on, zeros for those without a record. The view and the
// camera of `in` are unused.
void project_backward(const ProjectBackwardInput& in, const ItemBatch& batch,
                      const GradientSlots& slots, const GaussianRows<float>& out,
                      cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
