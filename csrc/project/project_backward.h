#pragma once

// Backward pass of projection on CUDA: from the gradients of the records of a frame that shows one
// model to those of the model's gaussians.

#include "base/device.h"
#include "frame/draw_list.h"
#include "frame/gradient_slots.h"

namespace v3dg {
namespace cuda {

// Gives each record of a frame its slots, from `first_slot` of the record on, and counts all slots
// in the counters. Does nothing when the items exceed a capacity.
void place_slots(const ItemList& items, const uint32_t* item_records, const RecordBox* boxes,
                 uint32_t* first_slot, cudaStream_t stream);

struct ProjectBackwardInput {
    // Items have kItemSize gaussians, except for the last. The records of item i are consecutive
    // from i * kItemSize on, in the order of their gaussians.
    const uint32_t* item_records;  // how many of an item's gaussians became records
    RecordPlanes records;
    const uint32_t* source;  // each record's gaussian
    GaussianRows<const float> rows;
    ModelView<float> view;
    Intrinsics<float> camera;
    float filter_px2;
    bool antialiased;
};

// Writes the gradients of every gaussian, zeros for those without a record. Those of the SH
// coefficients begin at a multiple of 16 bytes, as the coefficients do. The slots have sizes where
// `centers` does.
void project_backward(const ProjectBackwardInput& in, const GradientSlots& slots,
                      const GaussianRows<float>& out, const CenterGradients<float>& centers,
                      cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
