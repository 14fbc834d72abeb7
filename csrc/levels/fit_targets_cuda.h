#pragma once

// Draws the target pictures for fitting groups, on CUDA.

#include "draw/frame_cuda.h"
#include "fit_group/fit_group_math.h"
#include "levels/fit_level_cuda.h"

namespace v3dg {
namespace cuda {

// Computes the views of all pictures of the jobs. `jobs` are in device memory.
void make_views(const FitConfig& config, Span<const FitJob> jobs, FitView* views,
                cudaStream_t stream);

// Draws the target pictures of all jobs, with the rules of v3dg::fit_target().
// `targets` has the layout of FitGroupsInput::targets.
void draw_targets(const FitConfig& config, Span<const FitJob> jobs, const FitJob* jobs_on_device,
                  const DeviceFitTarget& target, const FitView* views, float4* targets,
                  Frame& frame, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
