#pragma once

// What the sensor pass on CUDA needs of records beside what blending reads.

#include "project/project_cuda.h"
#include "rasterize/sense.h"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

// The scene of a frame with channels.
struct SensedScene {
    // The scene, whose instances and labels the channels show. Null if the frame draws
    // one asset, which is instance 0.
    const SceneTables* scene = nullptr;
    // Placement p belongs to camera p / num_slots, and to slot p % num_slots there.
    uint32_t num_slots = 1;
    // The cameras of a batch, on the device. Null if slots are instances.
    const BatchCamera* cameras = nullptr;
};

// The records of a frame, and the gaussians that they were made of.
struct SensedRecordsInput {
    ItemList items;
    const uint32_t* item_records;  // number of records of each item
    const uint32_t* source;        // as in ProjectOutput
    const Placement* placements;
    // Models as in ProjectInput. Normals of packed models are those of the rows, if the
    // model has rows. `models` is null if no model has.
    const GaussianRows<const float>* models;
    const PackedPlanes* packed;
    const CodedGaussians* coded;
    SensedScene scene;
    EnvironmentTable environments;  // those of the scene, on the device
};

// Writes the normal (N, 3) and the instance (N) of each record. Either array may be
// null. Does nothing if the items exceed a capacity.
void find_sensed_records(const SensedRecordsInput& in, float* normal, int32_t* instance,
                         cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
