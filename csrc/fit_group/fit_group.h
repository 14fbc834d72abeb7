#pragma once

#include <atomic>
#include <cstdint>
#include <vector>

#include "base/buffer.h"
#include "base/isa.h"
#include "fit_group/dssim.h"
#include "frame/entry.h"
#include "frame/record.h"
#include "math/gaussian.h"

namespace v3dg {

// How a group is fitted ("local splatting": V3DG, section 3.2, and docs/levels.md for what we do
// differently).
struct FitConfig {
    int steps;
    int views_per_step;
    int num_views;           // fixed views, cached, beside those held out; 0: a fresh one each time
    int supersample;         // targets are drawn this much larger and box-averaged
    int image_size;          // px; 0: as large as the group is when it is selected
    float px2_per_gaussian;  // of the ball's footprint, where image_size is 0
    float distance;          // of the camera from the centre, in radii
    float filter_px2;        // of the gaussians that are fitted, with compensated opacity
    bool antialiased;
    LossWeights loss;
    // Step sizes of Adam: position in radii or, if `position_in_world`, in world units; the last
    // step takes `final_step` of them, exponentially. `beta2` is the decay of its mean of squared
    // gradients.
    float step_position, step_log_scale, step_quat, step_logit, step_sh0, step_sh_rest;
    bool position_in_world;
    float final_step, beta2;
    uint64_t seed;
};

// One group: the gaussians it should look like, and the ball that is looked at.
struct FitGroup {
    uint64_t target_first, target_count;  // in the target model
    uint64_t first, count;                // in the rows that are fitted
    float center[3], radius;
    uint64_t stream;  // of random numbers
};

struct FitTarget {
    const GaussianPlanes<float>* model;
    float filter_px2;
    bool antialiased;
};

// Shared with whoever waits for the result.
struct FitProgress {
    std::atomic<uint64_t> groups_done{0};
    std::atomic<double> loss_sum{0};
    std::atomic<bool> cancel{false};
};

// A view of the group in the group's own frame: centre at 0, radius 1.
struct FitView {
    float rotation[9];
    float focal, cx, cy;  // px
    int size;             // of the square image, px
};

// Colour and alpha of the target in one view, in the layout of tiles (fit_group_cpu.cpp).
using FitImage = std::vector<float>;

struct FitScratch {
    Buffer<Record<float>> records;
    Buffer<uint32_t> source;
    EntryFormat format;  // of the order, which leaves boxes out
    Buffer<uint64_t> order, order_scratch, row;
};

// Throws std::invalid_argument where a picture of the group would have a side of more than 65,535
// px.
void check_size(const FitConfig& config, const FitGroup& group);

// View `index` of a group; those held out have the indices that held_out_view() gives.
FitView fit_view(const FitConfig& config, const FitGroup& group, uint64_t index);

// Draws the target in one view.
V3DG_DECLARE_PER_ISA(void fit_target(const FitConfig& config, const FitGroup& group,
                                     const FitTarget& target, const FitView& view,
                                     FitScratch& scratch, FitImage& image))

// Fits one group: `rows` hold the start on entry and the result on return, in world units, as
// values without logs or logits. `targets` holds the pictures of the fixed views and then of those
// held out. Writes the residual of the result, mean |colour| and |alpha| over the views held out. A
// result that is no better there than the start, or not finite, is thrown away.
V3DG_DECLARE_PER_ISA(void fit_group(const FitConfig& config, const FitGroup& group,
                                    const FitTarget& target, const FitImage* targets,
                                    const GaussianRows<float>& rows, float error[2],
                                    const std::atomic<bool>& cancel))

}  // namespace v3dg
