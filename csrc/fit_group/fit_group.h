#pragma once

// Fits the gaussians of groups by pictures, so that they look like the gaussians that
// they replace: one group on one thread of the CPU, or all groups of a level at once on
// CUDA.

#include <atomic>
#include <cstdint>
#include <vector>

#include "base/buffer.h"
#include "base/isa.h"
#include "base/span.h"
#include "base/stream.h"
#include "fit_group/dssim.h"
#include "frame/entry.h"
#include "frame/record.h"
#include "math/gaussian.h"

struct float4;  // a type of CUDA

namespace v3dg {

struct FitStep;  // defined in fit_group_math.h

// Settings of a fit ("local splatting": V3DG, section 3.2; docs/levels.md says what we
// do differently).
struct FitConfig {
    int steps;
    int views_per_step;
    // Number of fixed, cached views, without those held out; 0: every visit uses a new
    // view.
    int num_views;
    int supersample;         // targets are drawn larger by this factor and box-averaged
    int image_size;          // px; 0: the size of the group when it is selected
    float px2_per_gaussian;  // area of the ball's footprint per gaussian, if image_size is 0
    float distance;          // distance of the camera from the centre, in radii
    float filter_px2;        // filter of the fitted gaussians, whose opacities are compensated
    bool antialiased;
    LossWeights loss;
    // Step sizes of Adam. The position's is in radii or, if `position_in_world`, in
    // world units. They decay exponentially, to `final_step` times their initial value
    // in the last step. `beta2` is the decay of Adam's mean of squared gradients.
    float step_position, step_log_scale, step_quat, step_logit, step_sh0, step_sh_rest;
    bool position_in_world;
    float final_step, beta2;
    uint64_t seed;
};

// One group: its targets, its gaussians, and the ball that its views show.
struct FitGroup {
    uint64_t target_first, target_count;  // rows of the target model
    uint64_t first, count;                // rows that are fitted
    float center[3], radius;
    uint64_t stream;  // seed of its random numbers
};

struct FitTarget {
    const GaussianPlanes<float>* model;
    float filter_px2;
    bool antialiased;
};

// Progress, shared with the thread that waits for the result.
struct FitProgress {
    std::atomic<uint64_t> groups_done{0};
    std::atomic<double> loss_sum{0};
    std::atomic<bool> cancel{false};
};

// A view of the group in the group's coordinates: centre at 0, radius 1.
struct FitView {
    float rotation[9];
    float focal, cx, cy;  // px
    int size;             // side of the square image, px
};

// Colour and alpha of the target in one view, in the tile layout of group_picture.h.
using FitImage = std::vector<float>;

struct FitScratch {
    Buffer<Record<float>> records;
    Buffer<uint32_t> source;
    EntryFormat format;  // format of the sort keys; records have no boxes
    Buffer<uint64_t> order, order_scratch, row;
};

// Throws std::invalid_argument if a side of the group's pictures would exceed 65,535
// px.
void check_size(const FitConfig& config, const FitGroup& group);

// Returns view `index` of a group; held_out_view() has the indices of the views held
// out.
FitView fit_view(const FitConfig& config, const FitGroup& group, uint64_t index);

// Draws the target in one view.
V3DG_DECLARE_PER_ISA(void fit_target(const FitConfig& config, const FitGroup& group,
                                     const FitTarget& target, const FitView& view,
                                     FitScratch& scratch, FitImage& image))

// Fits one group: `rows` has the initial values on entry and the result on return, in
// world units, as plain values instead of logarithms and logits. `targets` has the
// pictures of the fixed views, then those of the views held out. Writes the residual of
// the result, mean |colour| and |alpha| differences over the views held out. A result
// that is not better there than the initial values, or not finite, is discarded.
V3DG_DECLARE_PER_ISA(void fit_group(const FitConfig& config, const FitGroup& group,
                                    const FitTarget& target, const FitImage* targets,
                                    const GaussianRows<float>& rows, float error[2],
                                    const std::atomic<bool>& cancel))

namespace cuda {

// Signals between a running fit and the host, in memory that both access.
struct FitSignals {
    unsigned long long groups_done;
    unsigned long long loss_sum;  // unit: 2^-32
    int cancel;
};

// A group, with the indices of its pictures, views and residual.
struct FitJob {
    FitGroup group;
    uint64_t first_pixel;  // index of its first pixel in `targets`
    uint64_t first_view;   // index of its first view in `views`
    uint32_t error;        // index of its residual in `error`
    int size;              // side of its pictures, px
};

// The groups to fit and their targets. All pointers, including those in `rows`, are to
// device memory.
struct FitGroupsInput {
    FitConfig config;
    uint64_t stride;  // result of visiting_stride()
    Span<const FitJob> jobs;
    const float4* targets;  // colour and alpha, picture by picture, row major
    const FitView* views;   // one per picture
    const FitStep* steps;   // config.steps elements
    GaussianRows<float> rows;
    float* error;
    FitSignals* signals;
};

// Writes the step sizes of each step of Adam to device memory.
void make_steps(const FitConfig& config, FitStep* steps, Stream stream);

// The size of a whole level, which determines how groups are assigned to blocks. It is
// that of the level, not of the groups that are fitted together, so that the amount of
// free memory changes no bits.
struct FitExtent {
    size_t num_groups;
    uint32_t most;  // largest number of gaussians in a group
    int largest;    // largest side of a picture, px
};
FitExtent extent_of(Span<const FitJob> jobs);

// Fits all groups at once, as v3dg::fit_group fits one; jobs are best sorted by falling
// size. The signals count the finished groups. Once the signals request cancellation,
// unfinished groups keep their initial values. Work is queued on the stream. Throws
// std::runtime_error if CUDA reports an error, or if the device has too little shared
// memory.
void fit_groups(const FitGroupsInput& in, const FitExtent& level, Stream stream);

}  // namespace cuda

}  // namespace v3dg
