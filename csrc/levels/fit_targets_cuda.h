#pragma once

// The pictures that groups are fitted to, on CUDA.

#include "draw/frame_cuda.h"
#include "fit_group/fit_group_math.h"
#include "levels/fit_level_cuda.h"

namespace v3dg {
namespace cuda {

// Writes the views of all pictures of the jobs, which are on the device.
void make_views(const FitConfig& config, Span<const FitJob> jobs, FitView* views,
                cudaStream_t stream);

// Draws the pictures, as v3dg::fit_target does, into `targets` (FitGroupsInput).
void draw_targets(const FitConfig& config, Span<const FitJob> jobs, const FitJob* jobs_on_device,
                  const DeviceFitTarget& target, const FitView* views, float4* targets,
                  Frame& frame, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
