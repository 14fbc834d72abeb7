#pragma once

// Fits the gaussians of groups to what the groups replace, by pictures of both: one group on one
// thread of the CPU, or all groups of a level at once on CUDA.

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

struct float4;  // CUDA's

namespace v3dg {

struct FitStep;  // fit_group_math.h

// Settings of a fit ("local splatting": V3DG, section 3.2; docs/levels.md says what we do
// differently).
struct FitConfig {
    int steps;
    int views_per_step;
    int num_views;    // fixed views, cached, besides those held out; 0: each visit has a fresh one
    int supersample;  // targets are drawn this much larger and box-averaged
    int image_size;   // px; 0: the group's size when it is selected
    float px2_per_gaussian;  // area of the ball's footprint, if image_size is 0
    float distance;          // distance of the camera from the centre, in radii
    float filter_px2;        // filter of the fitted gaussians, whose opacity is compensated
    bool antialiased;
    LossWeights loss;
    // Step sizes of Adam. The position's is in radii or, if `position_in_world`, in world units.
    // They decay exponentially to `final_step` of themselves in the last step. `beta2` is the decay
    // of its mean of squared gradients.
    float step_position, step_log_scale, step_quat, step_logit, step_sh0, step_sh_rest;
    bool position_in_world;
    float final_step, beta2;
    uint64_t seed;
};

// One group: its targets, its gaussians, and the ball that views look at.
struct FitGroup {
    uint64_t target_first, target_count;  // rows of the target model
    uint64_t first, count;                // fitted rows
    float center[3], radius;
    uint64_t stream;  // stream of random numbers
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

// A view of the group in the group's own frame: centre at 0, radius 1.
struct FitView {
    float rotation[9];
    float focal, cx, cy;  // px
    int size;             // side of the square image, px
};

// Colour and alpha of the target in one view, in the layout of tiles (group_picture.h).
using FitImage = std::vector<float>;

struct FitScratch {
    Buffer<Record<float>> records;
    Buffer<uint32_t> source;
    EntryFormat format;  // format of the order, which has no boxes
    Buffer<uint64_t> order, order_scratch, row;
};

// Throws std::invalid_argument where a side of the group's pictures would exceed 65,535 px.
void check_size(const FitConfig& config, const FitGroup& group);

// Returns view `index` of a group; views held out have the indices of held_out_view().
FitView fit_view(const FitConfig& config, const FitGroup& group, uint64_t index);

// Draws the target in one view.
V3DG_DECLARE_PER_ISA(void fit_target(const FitConfig& config, const FitGroup& group,
                                     const FitTarget& target, const FitView& view,
                                     FitScratch& scratch, FitImage& image))

// Fits one group: `rows` hold the start on entry and the result on return, in world units, as
// values without logs or logits. `targets` has the pictures of the fixed views and then those of
// the views held out. Writes the residual of the result, mean |colour| and |alpha| over the views
// held out. A result that is no better there than the start, or not finite, is discarded.
V3DG_DECLARE_PER_ISA(void fit_group(const FitConfig& config, const FitGroup& group,
                                    const FitTarget& target, const FitImage* targets,
                                    const GaussianRows<float>& rows, float error[2],
                                    const std::atomic<bool>& cancel))

namespace cuda {

// Signals between a running fit and the host, in memory that both see.
struct FitSignals {
    unsigned long long groups_done;
    unsigned long long loss_sum;  // unit: 2^-32
    int cancel;
};

// A group with the place of its pictures and of its result.
struct FitJob {
    FitGroup group;
    uint64_t first_pixel;  // index of its first pixel in `targets`
    uint64_t first_view;   // index of its first view in `views`
    uint32_t error;        // index of its pair in `error`
    int size;              // side of its pictures, px
};

// The groups to fit and what they are compared with. All pointers are the device's; so are the rows
// of `rows`.
struct FitGroupsInput {
    FitConfig config;
    uint64_t stride;  // visiting_stride()
    Span<const FitJob> jobs;
    const float4* targets;  // colour and alpha, picture by picture, row major
    const FitView* views;   // one a picture
    const FitStep* steps;   // config.steps
    GaussianRows<float> rows;
    float* error;
    FitSignals* signals;
};

// Writes the step sizes of each step of Adam, on the device.
void make_steps(const FitConfig& config, FitStep* steps, Stream stream);

// The extent of a whole level. How blocks take groups follows from it, and not from the groups
// whose pictures fit into memory together, so that free memory changes no bits.
struct FitExtent {
    size_t num_groups;
    uint32_t most;  // largest number of gaussians of a group
    int largest;    // largest side of a picture, px
};
FitExtent extent_of(Span<const FitJob> jobs);

// Fits all groups at once, as v3dg::fit_group fits one; jobs are best ordered by falling size. The
// signals count the groups that are done. Once they say cancel, groups under way stay as they were.
// Work is queued on the stream. Throws std::runtime_error when CUDA reports an error, or where the
// device has too little shared memory.
void fit_groups(const FitGroupsInput& in, const FitExtent& level, Stream stream);

}  // namespace cuda

}  // namespace v3dg
