#pragma once

// Fits the gaussians of groups, so that they look like the finer gaussians that they
// replace. fit_group() fits one group on one CPU thread, and fit_groups() fits all
// groups of a level on CUDA.

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

struct float4;  // CUDA's vector type

namespace v3dg {

struct FitStep;  // defined in fit_group_math.h

// The settings of a fit ("local splatting" in V3DG, section 3.2). docs/levels.md lists
// the differences from the paper.
struct FitConfig {
    int steps;
    int views_per_step;
    // Number of fixed views whose targets are kept, without the held-out views. If it
    // is 0, each step uses a new view.
    int num_views;
    int supersample;  // targets are drawn this many times larger, then averaged
    int image_size;   // px; if 0, it is derived from px2_per_gaussian
    // Area, px², of the ball's footprint per gaussian. Used if image_size is 0.
    float px2_per_gaussian;
    float distance;    // distance from the camera to the centre, in radii
    float filter_px2;  // filter of the fitted gaussians, px²
    bool antialiased;
    LossWeights loss;
    // The step sizes of Adam. The step size of positions is relative to the radius or,
    // if `position_in_world`, in world units. Step sizes decay exponentially to
    // `final_step` times the initial value in the last step. `beta2` is Adam's decay
    // rate of the mean of squared gradients.
    float step_position, step_log_scale, step_quat, step_logit, step_sh0, step_sh_rest;
    bool position_in_world;
    float final_step, beta2;
    uint64_t seed;
};

// One group: its target, the gaussians to fit, and the ball that its views show.
struct FitGroup {
    uint64_t target_first, target_count;  // rows of the target model
    uint64_t first, count;                // rows of the gaussians to fit
    float center[3], radius;
    uint64_t stream;  // selects the group's sequence of random numbers
};

struct FitTarget {
    const GaussianPlanes<float>* model;
    float filter_px2;
    bool antialiased;
};

// The progress of a fit. It is shared with the thread that waits for the fit.
struct FitProgress {
    std::atomic<uint64_t> groups_done{0};
    std::atomic<double> loss_sum{0};
    std::atomic<bool> cancel{false};
};

// A view of a group, in the group's coordinates, in which the ball is at 0 and has
// radius 1.
struct FitView {
    float rotation[9];
    float focal, cx, cy;  // px
    int size;             // side of the square picture, px
};

// Colour and alpha of the target in one view, in the tile layout of group_picture.h.
using FitImage = std::vector<float>;

struct FitScratch {
    Buffer<Record<float>> records;
    Buffer<uint32_t> source;
    EntryFormat format;  // format of `order`; records have no boxes
    Buffer<uint64_t> order, order_scratch, row;
};

// Throws std::invalid_argument if the side of the group's pictures would exceed 65,535
// px.
void check_size(const FitConfig& config, const FitGroup& group);

// Returns view `index` of a group. held_out_view() returns the indices of held-out
// views.
FitView fit_view(const FitConfig& config, const FitGroup& group, uint64_t index);

// Draws the target in one view.
V3DG_DECLARE_PER_ISA(void fit_target(const FitConfig& config, const FitGroup& group,
                                     const FitTarget& target, const FitView& view,
                                     FitScratch& scratch, FitImage& image))

// Fits one group. `rows` has the initial values and receives the result, in world
// units, with plain scales and opacities. `targets` has the pictures of the fixed
// views, followed by those of the held-out views. It is not used if there are no fixed
// views.
//
// `error` receives the residual on the held-out views: the mean absolute differences of
// colour and of alpha. If the result is not finite, or not better on these views, the
// initial values are kept.
V3DG_DECLARE_PER_ISA(void fit_group(const FitConfig& config, const FitGroup& group,
                                    const FitTarget& target, const FitImage* targets,
                                    const GaussianRows<float>& rows, float error[2],
                                    const std::atomic<bool>& cancel))

namespace cuda {

// Signals between a running fit and the host. They are in memory that both can access.
struct FitSignals {
    unsigned long long groups_done;
    unsigned long long loss_sum;  // in units of 2^-32
    int cancel;
};

// A group to fit, and the locations of its pictures, views and residual.
struct FitJob {
    FitGroup group;
    uint64_t first_pixel;  // index of the job's first pixel in `targets`
    uint64_t first_view;   // index of the job's first view in `views`
    uint32_t error;        // index of the job's residual in `error`
    int size;              // side of the job's pictures, px
};

// The groups to fit, and their targets. All pointers, including those in `rows`, point
// to device memory.
struct FitGroupsInput {
    FitConfig config;
    uint64_t stride;  // returned by visiting_stride()
    Span<const FitJob> jobs;
    const float4* targets;  // colour and alpha; one picture after another, in row-major
                            // order
    const FitView* views;   // one per picture
    const FitStep* steps;   // [config.steps]
    GaussianRows<float> rows;
    float* error;
    FitSignals* signals;
};

// Computes the step sizes of each step of Adam, in device memory.
void make_steps(const FitConfig& config, FitStep* steps, Stream stream);

// The size of a whole level, which determines how many blocks fit a group. It counts
// all groups of the level, even if they are fitted in several batches. Therefore the
// bits of the result do not depend on free memory.
struct FitExtent {
    size_t num_groups;
    uint32_t most;  // maximum number of gaussians in a group
    int largest;    // largest side of a picture, px
};
FitExtent extent_of(Span<const FitJob> jobs);

// Enqueues the fits of all groups, with the rules of v3dg::fit_group(). Jobs should be
// sorted by descending size. The kernel counts finished groups in in.signals. When the
// host sets its `cancel`, groups that are not finished keep their initial values.
// Throws std::runtime_error if CUDA reports an error, or if the device has too little
// shared memory.
void fit_groups(const FitGroupsInput& in, const FitExtent& level, Stream stream);

}  // namespace cuda

}  // namespace v3dg
