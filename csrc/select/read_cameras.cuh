#pragma once

// Reads the cameras of a batch from the caller's arrays.

#include "camera/camera_arrays.h"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

__device__ inline double number_of(const void* numbers, bool are_double, size_t i) {
    return are_double ? static_cast<const double*>(numbers)[i]
                      : static_cast<double>(static_cast<const float*>(numbers)[i]);
}

// Returns the environment of a camera. For an invalid number, returns an environment
// that no scene has.
__device__ inline int32_t environment_of(const CameraArrays& arrays, uint32_t b) {
    if (arrays.environments == nullptr) return kSeesAll;
    if (!arrays.are_environments_long) {
        const int32_t environment = static_cast<const int32_t*>(arrays.environments)[b];
        return environment < kShared ? kMostEnvironment + 1 : environment;
    }
    const int64_t environment = static_cast<const int64_t*>(arrays.environments)[b];
    const bool is_one = environment >= kShared && environment <= kMostEnvironment;
    return is_one ? static_cast<int32_t>(environment) : kMostEnvironment + 1;
}

__device__ inline BatchCamera read_camera(const CameraArrays& arrays,
                                          const EnvironmentTable& environments, uint32_t b) {
    double viewmat[16], K[9];
    for (int k = 0; k < 16; ++k)
        viewmat[k] = number_of(arrays.viewmats, arrays.are_viewmats_double, 16 * size_t(b) + k);
    const size_t first = arrays.shares_intrinsics ? 0 : 9 * size_t(b);
    for (int k = 0; k < 9; ++k)
        K[k] = number_of(arrays.intrinsics, arrays.are_intrinsics_double, first + k);
    const int32_t environment = environment_of(arrays, b);
    const bool is_drawn =
        fault_of_camera(viewmat, K) == CameraFault::none && environments.has(environment);
    return {.camera = camera_of(viewmat, K, arrays.width, arrays.height, arrays.near_depth),
            .environment = environment,
            .is_drawn = is_drawn ? 1u : 0u};
}

}  // namespace cuda
}  // namespace v3dg
