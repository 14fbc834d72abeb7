#pragma once

// Computes the additional data of records that the sensor pass on CUDA needs.

#include "project/project_cuda.h"
#include "rasterize/sense.h"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

// The scene that the channels of a frame show.
struct SensedScene {
    // The scene whose instances and labels the channels show. Null if the frame draws
    // one asset; its gaussians belong to instance 0.
    const SceneTables* scene = nullptr;
    // Placement p belongs to camera p / num_slots, and to slot p % num_slots there.
    uint32_t num_slots = 1;
    // The cameras of a batch, on the device. Null if a slot's index is the instance.
    const BatchCamera* cameras = nullptr;
};

// The records of a frame, and the gaussians that they were projected from.
struct SensedRecordsInput {
    ItemList items;
    const uint32_t* item_records;  // number of records of each item
    const uint32_t* source;        // as in ProjectOutput
    const Placement* placements;
    // Models as in ProjectInput. `models` is null if no model has rows. For a packed
    // model with rows, normals are computed from the rows.
    const GaussianRows<const float>* models;
    const PackedPlanes* packed;
    const CodedGaussians* coded;
    SensedScene scene;
    EnvironmentTable environments;  // the environments of the scene, on the device
};

// Writes the normal (N, 3) and the instance (N) of each record. Either array may be
// null. Does nothing if the number of items exceeds their capacity.
void find_sensed_records(const SensedRecordsInput& in, float* normal, int32_t* instance,
                         cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
