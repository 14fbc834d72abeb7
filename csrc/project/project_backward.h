#pragma once

// The way back from the records of a CUDA frame that shows one model to the gaussians of that model.

#include "base/device.h"
#include "pipeline/frame_types.h"
#include "rasterize/rasterize_backward.h"

namespace v3dg {
namespace cuda {

struct ProjectBackwardInput {
    DeviceRows model;
    uint64_t size;  // gaussians
    ModelView<float> view;
    Pinhole<float> camera;
    float filter_px2;
    bool compensate;
    // Items of kItemSize gaussians, the last of what is left. The records of item i stand in a row from
    // i * kItemSize on, in the order of their gaussians.
    const uint32_t* item_records;  // how many
    const Record<float>* records;
    const uint32_t* source;  // each record's gaussian
};

// Gives each record its slots and adds what that takes to `num_slots`, which starts at 0.
void place_slots(const ProjectBackwardInput& in, uint32_t* first_slot, unsigned long long* num_slots,
                 cudaStream_t stream);

// Writes the gradients of every gaussian, zeros for those without a record.
void project_backward(const ProjectBackwardInput& in, const GradientSlots& slots,
                      const GaussianGradients<float>& out, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
