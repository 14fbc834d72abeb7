#pragma once

// The way back from the records of a CUDA frame that shows one model to the gaussians of that model.

#include "base/device.h"
#include "pipeline/frame_types.h"
#include "rasterize/rasterize_backward.h"

namespace v3dg {
namespace cuda {

// The records of a model's gaussians, kItemSize gaussians an item, the last of what is left. Those of item i
// stand in a row from i * kItemSize on, in the order of their gaussians.
struct ModelRecords {
    uint64_t size;                 // gaussians
    const uint32_t* item_records;  // how many of an item's gaussians became records
    const Record<float>* records;
};

struct ProjectBackwardInput {
    ModelRecords made;
    const uint32_t* source;  // each record's gaussian
    DeviceRows rows;
    ModelView<float> view;
    Pinhole<float> camera;
    float filter_px2;
    bool compensate;
};

// Gives each record its slots and adds what that takes to `num_slots`, which starts at 0.
void place_slots(const ModelRecords& made, uint32_t* first_slot, unsigned long long* num_slots,
                 cudaStream_t stream);

// Writes the gradients of every gaussian, zeros for those without a record. Those of the SH coefficients
// begin at a multiple of 16 bytes, as the coefficients do.
void project_backward(const ProjectBackwardInput& in, const GradientSlots& slots,
                      const GaussianGradients<float>& out, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
