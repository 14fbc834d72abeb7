#pragma once

#include "base/device.h"
#include "fit_group/fit_group_math.h"

namespace v3dg {
namespace cuda {

// Between a running fit and the host, in memory that both see.
struct FitSignals {
    unsigned long long groups_done;
    unsigned long long loss_sum;  // in units of 2^-32
    int cancel;
};

// A group with the place of its pictures and of its result.
struct FitJob {
    FitGroup group;
    uint64_t first_pixel;  // of its pictures, in `targets`
    uint64_t first_view;   // in `views`
    uint32_t error;        // in pairs
    int size;              // of its pictures, px
};

// All pointers are the device's; so are the rows of `rows`.
struct FitGroupsInput {
    FitConfig config;
    uint64_t stride;  // visiting_stride()
    Span<const FitJob> jobs;
    const float4* targets;  // colour and alpha, picture by picture, row major
    const FitView* views;   // as many as there are pictures
    const FitStep* steps;   // config.steps
    GaussianRows<float> rows;
    float* error;
    FitSignals* signals;
};

// Pictures that a group is compared with: its fixed views, or those of all steps; then those held
// out.
V3DG_HD inline uint64_t num_fitted_pictures(const FitConfig& config) {
    return config.num_views > 0 ? static_cast<uint64_t>(config.num_views)
                                : static_cast<uint64_t>(config.steps) * config.views_per_step;
}
V3DG_HD inline uint64_t num_pictures(const FitConfig& config) {
    return num_fitted_pictures(config) + kHeldOutViews;
}
V3DG_HD inline uint64_t view_of_picture(const FitConfig& config, uint64_t picture) {
    const uint64_t num_fitted = num_fitted_pictures(config);
    return picture < num_fitted ? picture
                                : held_out_view(config, static_cast<int>(picture - num_fitted));
}

// Writes what each step of Adam takes, on the device.
void make_steps(const FitConfig& config, FitStep* steps, cudaStream_t stream);

// The groups of a whole level. How blocks take groups follows from this, and not from those whose
// pictures fit into memory together, so that free memory changes no bits.
struct FitExtent {
    size_t num_groups;
    uint32_t most;  // gaussians of a group
    int largest;    // px a side of a picture
};
FitExtent extent_of(Span<const FitJob> jobs);

// As v3dg::fit_group, for all groups at once; jobs are best ordered by falling size. Groups done
// are counted in the signals; when they say cancel, groups under way stay as they were.
void fit_groups(const FitGroupsInput& in, const FitExtent& level, cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
