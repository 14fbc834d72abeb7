// Fits groups on CUDA. A block, or a team of blocks, fits one group from start to end,
// then claims the next one.
//
// In each step, threads project the gaussians and sort them by depth. Half-warps
// process cells of 4 x 4 pixels. They list the gaussians that reach the cell, blend
// them front to back, and compare the result with the target. Then they visit the
// gaussians again to compute gradients. Each gaussian has a slot per cell. Threads add
// up the slots in a fixed order, propagate the sums to the parameters, and perform a
// step of Adam. Therefore every run gives the same result, in whatever order blocks and
// warps run.

#include "fit_group/fit_group.h"

#include <algorithm>
#include <stdexcept>

#include "fit_group/blend_cells.cuh"
#include "fit_group/fit_dssim.cuh"
#include "fit_group/parameters.cuh"
#include "fit_group/project_views.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr int kStepsPerPoll = 16;

template <class Fit>
__device__ void set_camera(const Fit& fit, FitCameras& cameras, int b, uint64_t picture) {
    const FitView view = fit.in.views[fit.job.first_view + picture];
    cameras.view[b] = view_of_group(fit.in.config, view);
    cameras.camera[b] = camera_of(view, 1);
    cameras.target[b] =
        fit.in.targets + fit.job.first_pixel + picture * fit.job.size * fit.job.size;
}

// Adds the absolute differences of colour and of alpha, summed over pixels, to `error`.
// Every thread gets the sums.
template <class Fit>
__device__ void measure_views(const Fit& fit, const FitCameras& cameras, int num_views,
                              double error[2]) {
    BlendTargets targets{};
    targets.errors = fit.template hot_at<float2>(fit.layout.errors);
    blend_regions<Pass::measure>(fit, cameras, num_views, 0, fit.num_regions(), targets);
    fit.sync();
    for (int unit = 0; unit < num_views * cell_rows(fit) * cell_pairs(fit); ++unit) {
        error[0] += static_cast<double>(targets.errors[unit].x);
        error[1] += static_cast<double>(targets.errors[unit].y);
    }
    if (fit.leads()) fit.team.unit = 0;
}

// Computes the gradients of the parameters for each view.
template <class Fit>
__device__ void differentiate_views(const Fit& fit, const FitCameras& cameras, int num_views,
                                    int turn) {
    BlendTargets targets{};
    if (fit.in.config.loss.dssim > 0) {
        const size_t planes = static_cast<size_t>(3 * kViewsAtOnce) * fit.job.size * fit.job.size;
        float* maps = reinterpret_cast<float*>(fit.scratch + fit.layout.maps);
        targets.picture = maps;
        blend_regions<Pass::draw>(fit, cameras, num_views, 0, fit.num_regions(), targets);
        fit.sync();
        if (fit.leads()) fit.team.unit = 0;
        dssim_backward(fit, cameras, num_views, maps, maps + planes, maps + 2 * planes);
        targets.d_dssim = maps + planes;
    }
    const uint32_t num_slots = assign_slots(fit, num_views);
    fit.sync();
    const bool is_near = num_slots <= fit.layout.num_near_slots;
    targets.slots = is_near ? fit.at(fit.layout.near_slots)
                            : reinterpret_cast<float*>(fit.scratch + fit.layout.far_slots);
    const uint32_t capacity = is_near ? num_slots : fit.layout.num_far_slots;
    // Process as many regions at once as there is memory for their slots.
    const auto slots_before = [&](int region) {
        return region < fit.num_regions() ? fit.slot_first(region)[0] : num_slots;
    };
    for (int region = 0; region < fit.num_regions();) {
        int last = region + 1;
        targets.slot_base = slots_before(region);
        while (last < fit.num_regions() && slots_before(last + 1) - targets.slot_base <= capacity)
            ++last;
        blend_regions<Pass::train>(fit, cameras, num_views, region, last, targets);
        fit.sync();
        sum_slots(fit, num_views, targets.slots, targets.slot_base, region, last);
        if (fit.leads()) fit.team.unit = 0;
        fit.sync();
        region = last;
    }
    project_views_backward(fit, cameras, num_views, turn);
}

// Adds up the errors of all blocks of the group. Every block gets the sums.
template <class Fit>
__device__ void sum_errors(const Fit& fit, double error[2][2]) {
    if (threadIdx.x == 0)
        for (int e = 0; e < 4; ++e)
            fit.all.error[fit.view_rank][e / 2][e % 2] = error[e / 2][e % 2];
    fit.arrive_and_wait(-1);
    for (int e = 0; e < 4; ++e) {
        error[e / 2][e % 2] = 0;
        for (unsigned rank = 0; rank < fit.view_stride; ++rank)
            error[e / 2][e % 2] += fit.all.error[rank][e / 2][e % 2];
    }
}

// Writes the result if its loss is at most the loss of the initial values. `error` has
// sums over pixels: first for the initial values, then for the result.
template <class Fit>
__device__ void keep_if_better(const Fit& fit, double error[2][2]) {
    const FitConfig& config = fit.in.config;
    const double num_pixels = static_cast<double>(fit.job.size) * fit.job.size * kHeldOutViews;
    for (int e = 0; e < 2; ++e) {
        error[e][0] /= 3 * num_pixels;
        error[e][1] /= num_pixels;
    }
    const bool better =
        config.steps > 0 &&
        residual_loss(config.loss, error[1]) <= residual_loss(config.loss, error[0]) &&
        write_parameters(fit);
    if (!fit.leads()) return;
    for (int k = 0; k < 2; ++k)
        fit.in.error[2 * fit.job.error + k] = static_cast<float>(error[better][k]);
}

// Visits the held-out views, then the views of all steps, then the held-out views
// again. It processes up to kViewsAtOnce views at once.
template <class Fit>
__device__ void fit_one_group(const Fit& fit) {
    const FitConfig& config = fit.in.config;
    const int views_per_step = config.views_per_step;
    const int64_t num_visits = static_cast<int64_t>(config.steps) * views_per_step;
    // Visits in steps are numbered from 0 to num_visits - 1. The visits of held-out
    // views have numbers before and after these.
    const auto views_at = [&](int64_t visit) {
        const int64_t left = visit < 0            ? -visit
                             : visit < num_visits ? views_per_step - visit % views_per_step
                                                  : num_visits + kHeldOutViews - visit;
        return static_cast<int>(min(static_cast<int64_t>(kViewsAtOnce), left));
    };
    // Returns how many views of a batch this block processes.
    const auto own_of = [&](int num_views) {
        return fit.view_stride == 1                          ? num_views
               : static_cast<int>(fit.view_rank) < num_views ? 1
                                                             : 0;
    };
    const auto set_cameras = [&](FitCameras& cameras, int64_t first) {
        // The thread's index in the last warp, which has the least other work.
        const int b = static_cast<int>(threadIdx.x) - (Fit::kThreads - 32);
        if (b == kViewsAtOnce && first >= 0 && first < num_visits)
            cameras.step = fit.in.steps[first / views_per_step];
        if (b < 0 || b >= own_of(views_at(first))) return;
        const int64_t visit = first + fit.view_rank + b;
        const bool is_of_step = visit >= 0 && visit < num_visits;
        const int64_t held_out = visit < 0 ? visit + kHeldOutViews : visit - num_visits;
        set_camera(fit, cameras, b,
                   is_of_step ? visited_view(config, fit.in.stride, visit)
                              : num_fitted_pictures(config) + held_out);
    };
    double error[2][2] = {{0, 0}, {0, 0}};  // for the initial values, and for the
                                            // result
    start_parameters(fit);
    set_cameras(fit.s.cameras[0], -kHeldOutViews);
    if (fit.leads()) fit.team.unit = 0;
    fit.sync();
    int turn = 0;
    for (int64_t visit = -kHeldOutViews; visit < num_visits + kHeldOutViews; turn ^= 1) {
        const int num_views = views_at(visit), num_own = own_of(num_views);
        const FitCameras& cameras = fit.s.cameras[turn];
        project_views(fit, cameras, num_own);
        fit.sync();
        order_by_depth(fit, num_own);
        fit.sync();
        if (!Fit::kSmall) arrange_by_depth(fit, num_own);
        set_cameras(fit.s.cameras[turn ^ 1], visit + num_views);
        if (visit < 0 || visit >= num_visits) {
            measure_views(fit, cameras, num_own, error[visit >= 0]);
        } else {
            const int index = static_cast<int>(visit / views_per_step),
                      within = static_cast<int>(visit % views_per_step);
            if (fit.leads_all() && within == 0 && index % kStepsPerPoll == 0) fit.read_cancel(turn);
            differentiate_views(fit, cameras, num_own, turn);
            fit.sync_all(turn);
            if (fit.s.cancel) return;
            move_parameters(fit, cameras.step, num_views, turn, within == 0,
                            within + num_views == views_per_step);
        }
        fit.sync();
        visit += num_views;
    }
    if (fit.view_stride > 1) sum_errors(fit, error);
    if (fit.view_rank == 0) keep_if_better(fit, error);
}

// Computes the step sizes of all steps once, because powers are slow and all groups use
// the same values.
__global__ void steps_kernel(const FitConfig config, FitStep* steps) {
    const unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < static_cast<unsigned>(config.steps)) steps[i] = fit_step(config, static_cast<int>(i));
}

// The counters from which blocks claim groups.
struct FitQueue {
    unsigned arrived, next;
    unsigned long long groups_done, loss_sum;
};

template <class Shape, int kBlocks>
__global__ void __launch_bounds__(Shape::kThreads, kBlocks)
    fit_groups_kernel(const FitGroupsInput in, const FitLayout layout, unsigned char* scratch,
                      unsigned num_blocks, FitTeam* teams, FitQueue* queue) {
    __shared__ FitShared s;
    // A block's rank in its team follows from the order in which blocks arrive.
    // Therefore a block only waits for blocks that are running or certain to run.
    if (threadIdx.x == 0) s.arrival = atomicAdd(&queue->arrived, 1u);
    __syncthreads();
    FitBlock<Shape> fit(in, layout, s, teams, num_blocks, scratch);
    for (;;) {
        if (fit.leads_all()) {
            fit.all.ticket = atomicAdd(&queue->next, 1u);
            fit.read_cancel(kBetweenGroups);
        }
        fit.sync_all(kBetweenGroups);
        const unsigned ticket = *static_cast<volatile unsigned*>(&fit.all.ticket);
        if (ticket >= in.jobs.size || s.cancel) return;
        fit.begin_group(in.jobs.data[ticket]);
        fit_one_group(fit);
        if (s.cancel) return;
        fit.sync();
        if (!fit.leads_all()) continue;
        const float* error = in.error + 2 * fit.job.error;
        const double loss[2] = {error[0], error[1]};
        const auto share =
            static_cast<unsigned long long>(residual_loss(in.config.loss, loss) * 4294967296.0);
        volatile FitSignals* signals = in.signals;
        signals->loss_sum = atomicAdd(&queue->loss_sum, share) + share;
        signals->groups_done = atomicAdd(&queue->groups_done, 1ull) + 1;
    }
}

int attribute(cudaDeviceAttr name) {
    int device = 0, value = 0;
    check(cudaGetDevice(&device), "cudaGetDevice");
    check(cudaDeviceGetAttribute(&value, name, device), "cudaDeviceGetAttribute");
    return value;
}

// If `blocks` blocks (at most kBlocks) fit on a multiprocessor, launches the kernel and
// returns true. Otherwise, does nothing and returns false.
template <class Shape, int kBlocks>
bool run(const FitGroupsInput& in, uint32_t most, int largest, cudaStream_t stream,
         int blocks = kBlocks) {
    // Shared memory per block, in bytes, that the kernel's variables and the driver
    // need.
    const size_t reserved = sizeof(FitShared) + 1024;
    const size_t limit =
        (std::min<size_t>(
            attribute(cudaDevAttrMaxSharedMemoryPerBlockOptin) - sizeof(FitShared),
            attribute(cudaDevAttrMaxSharedMemoryPerMultiprocessor) / blocks - reserved)) /
        16 * 16;
    const size_t most_blocks =
        blocks * static_cast<size_t>(attribute(cudaDevAttrMultiProcessorCount));
    // Number of blocks per group. All of them must run concurrently.
    size_t num_blocks = 1;
    if (attribute(cudaDevAttrCooperativeLaunch) != 0)
        num_blocks = std::clamp<size_t>(
            most_blocks / in.jobs.size, 1,
            Shape::kSmall ? std::min(in.config.views_per_step, kViewsAtOnce) : kLargestTeam);
    const size_t num_groups = std::min<size_t>(in.jobs.size, most_blocks / num_blocks);
    const FitSizes sizes{.most_gaussians = most,
                         .floats_per_gaussian = 11 + static_cast<size_t>(in.rows.num_sh()),
                         .largest_picture = largest,
                         .has_dssim = in.config.loss.dssim > 0,
                         .num_blocks = num_blocks,
                         .shared_limit = limit};
    const FitLayout layout = layout_of<Shape>(sizes);
    if (layout.shared_bytes > limit) return false;
    const DeviceBuffer<unsigned char> scratch(
        num_groups * (Shape::kSmall ? num_blocks : 1) * layout.scratch_bytes, stream);
    const DeviceBuffer<FitTeam> teams(num_groups, stream);
    const DeviceBuffer<FitQueue> queue(1, stream);
    check(cudaMemsetAsync(teams.data(), 0, num_groups * sizeof(FitTeam), stream),
          "cudaMemsetAsync");
    check(cudaMemsetAsync(queue.data(), 0, sizeof(FitQueue), stream), "cudaMemsetAsync");
    launch("fit_groups_kernel", fit_groups_kernel<Shape, kBlocks>,
           static_cast<unsigned>(num_groups * num_blocks), Shape::kThreads, layout.shared_bytes,
           stream, in, layout, scratch.data(), static_cast<unsigned>(num_blocks), teams.data(),
           queue.data());
    return true;
}

}  // namespace

void make_steps(const FitConfig& config, FitStep* steps, cudaStream_t stream) {
    constexpr unsigned kThreads = 128;
    launch("steps_kernel", steps_kernel,
           (static_cast<unsigned>(config.steps) + kThreads) / kThreads, kThreads, 0, stream, config,
           steps);
}

FitExtent extent_of(Span<const FitJob> jobs) {
    FitExtent extent{jobs.size, 0, 0};
    for (const FitJob& job : jobs) {
        extent.most = std::max(extent.most, static_cast<uint32_t>(job.group.count));
        extent.largest = std::max(extent.largest, job.size);
    }
    return extent;
}

void fit_groups(const FitGroupsInput& in, const FitExtent& level, cudaStream_t stream) {
    const uint32_t most = level.most;
    const int largest = level.largest;
    const auto multiprocessors = static_cast<size_t>(attribute(cudaDevAttrMultiProcessorCount));
    // If there are many groups per multiprocessor, fitting three of them concurrently
    // is faster than two.
    const bool are_many = level.num_groups > multiprocessors,
               are_most = level.num_groups >= 6 * multiprocessors;
    const auto run_small = [&] {
        return (are_most && run<FitShape<256, true, 8>, 3>(in, most, largest, stream)) ||
               (are_many && run<FitShape<256, true, 16>, 2>(in, most, largest, stream)) ||
               run<FitShape<512, true, 16>, 1>(in, most, largest, stream) ||
               run<FitShape<256, true, 8>, 3>(in, most, largest, stream, 1);
    };
    // The shapes with fewer threads are for devices with less shared memory.
    const bool runs = most <= kSmallCount && largest <= kRegion
                          ? run_small()
                          : run<FitShape<512, false, 32>, 1>(in, most, largest, stream) ||
                                run<FitShape<256, false, 16>, 1>(in, most, largest, stream);
    if (!runs)
        throw std::runtime_error(
            "cuda: expected 96 KiB of shared memory per block, got less; fit on the CPU");
}

}  // namespace cuda
}  // namespace v3dg
