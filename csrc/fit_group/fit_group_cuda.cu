// A block, or a team of blocks, fits a group, start to end, then takes the next from a queue.
//
// One step: threads project gaussians and order them by depth; half-warps take cells of 4 x 4
// pixels, list the gaussians that reach them, blend them front to back, compare, and go through
// them again for the gradients; what a gaussian gets from each cell has its own slot, and slots are
// added up in a fixed order; threads carry that on to the parameters, and Adam moves them. So every
// run has the same result, whatever order blocks and warps come in.

#include "fit_group/fit_group_cuda.h"

#include <algorithm>
#include <stdexcept>
#include <type_traits>

#include "fit_group/blend_cells.cuh"
#include "fit_group/fit_dssim.cuh"
#include "fit_group/parameters.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr uint32_t kSmallCount = 256;  // gaussians of a small group, whose picture is one region
constexpr int kStepsPerPoll = 16;

// Calls `body` with the degree as a constant, which unrolls its loops.
template <class Body>
__device__ void with_degree(int degree, const Body& body) {
    switch (degree) {
        case 0: return body(std::integral_constant<int, 0>{});
        case 1: return body(std::integral_constant<int, 1>{});
        case 2: return body(std::integral_constant<int, 2>{});
        default: return body(std::integral_constant<int, 3>{});
    }
}

template <class Fit>
__device__ void set_camera(const Fit& fit, FitCameras& cameras, int b, uint64_t picture) {
    const FitView view = fit.in.views[fit.job.first_view + picture];
    cameras.view[b] = view_of_group(fit.in.config, view);
    cameras.camera[b] = camera_of(view, 1);
    cameras.target[b] =
        fit.in.targets + fit.job.first_pixel + picture * fit.job.size * fit.job.size;
}

template <class Fit>
__device__ bool project_one(const Fit& fit, uint32_t i, const ModelView<float>& view,
                            const Pinhole<float>& camera, Record<float>& r) {
    const Gaussian3d<float> g = gaussian_of(fit, i);
    Projection<float> p;
    to_view(view, g.mean, p.p);
    const Ellipse<float> e =
        project_gaussian(g, view, camera, fit.in.config.filter_px2, fit.in.config.antialiased, p);
    float half_x, half_y;
    if (!(e.depth >= camera.near_depth) || !extent_of(g.opacity, e, p, half_x, half_y))
        return false;
    if (!meets_image(e.u, half_x, camera.width) || !meets_image(e.v, half_y, camera.height))
        return false;
    const PixelBox<int> box = pixel_box(e, half_x, half_y, camera);
    if (!box.holds_pixels()) return false;
    set_ellipse(e, box, r);
    const float* sh = fit.at(fit.layout.value) + 11 * fit.n + fit.num_sh * i;
    float direction[3];
    from_eye(view, g.mean, direction);
    with_degree(fit.in.rows.sh_degree, [&](auto degree) {
        color_of_sh<float>(decltype(degree)::value, direction, sh, r.color);
    });
    return true;
}

template <class Fit>
__device__ void project_views(const Fit& fit, const FitCameras& cameras, int num_views) {
    for (uint32_t j = fit.first(); j < num_views * fit.n_padded; j += fit.stride()) {
        const uint32_t b = j / fit.n_padded, i = j - b * fit.n_padded;
        uint32_t key = kHiddenKey;
        CellMask reached = 0;
        if (i < fit.n) {
            Record<float> r;
            if (project_one(fit, i, cameras.view[b], cameras.camera[b], r)) {
                fit.records()[j] = r;
                key = __float_as_uint(r.depth);
                if (Fit::kSmall) reached = cells_of(r, 0, 0);
            }
        }
        fit.keys()[j] = key;
        if (Fit::kSmall) fit.mask(0)[j] = reached;
    }
    if (fit.leads()) {
        Record<float> r{};
        r.log2_opacity = -100;
        fit.ranked()[fit.nothing()] = r;
    }
}

// From the sums of records to gradients of the parameters, for each view.
template <class Fit>
__device__ void project_views_backward(const Fit& fit, const FitCameras& cameras, int num_views,
                                       int turn) {
    const float* sums = fit.at(fit.layout.sums);
    const float* value = fit.at(fit.layout.value);
    for (uint32_t j = fit.first(); j < num_views * fit.n_padded; j += fit.stride()) {
        const uint32_t b = j / fit.n_padded, place = Fit::kSmall ? j : fit.order()[j],
                       i = place - b * fit.n_padded;
        if (i >= fit.n) continue;
        float* out = fit.gradient(turn, fit.view_rank + b);
        float* d_sh = out + 11 * fit.n + fit.num_sh * i;
        if (Fit::kSmall ? fit.mask(0)[place] == 0 : fit.keys()[place] == kHiddenKey) {
            for (int k = 0; k < 11; ++k) out[k * fit.n + i] = 0;
            for (int k = 0; k < fit.num_sh; ++k) d_sh[k] = 0;
            continue;
        }
        const float* d = sums + kSumStride * j;
        const ModelView<float>& view = cameras.view[b];
        const Pinhole<float>& camera = cameras.camera[b];
        const float filter_px2 = fit.in.config.filter_px2;
        const bool antialiased = fit.in.config.antialiased;
        const Gaussian3d<float> g = gaussian_of(fit, i);
        Projection<float> p;
        to_view(view, g.mean, p.p);
        const Ellipse<float> e = project_gaussian(g, view, camera, filter_px2, antialiased, p);
        const Ellipse<float> d_ellipse = falloff_vjp(
            e.l11, e.l12, e.l22, FalloffSums<float>{d[0], d[1], d[2], d[3], d[4], d[5]});
        Gaussian3d<float> d_g =
            project_gaussian_vjp(g, view, camera, filter_px2, antialiased, p, e, d_ellipse);
        const float* sh = value + 11 * fit.n + fit.num_sh * i;
        float direction[3];
        from_eye(view, g.mean, direction);
        with_degree(fit.in.rows.sh_degree, [&](auto degree) {
            float color[3];
            constexpr int kDegree = decltype(degree)::value;
            color_of_sh<float>(kDegree, direction, sh, color);
            color_of_sh_vjp<float>(kDegree, direction, sh, color, d + 6, d_g.mean, d_sh);
        });
        for (int k = 0; k < 3; ++k) out[k * fit.n + i] = d_g.mean[k];
        for (int k = 0; k < 4; ++k) out[(3 + k) * fit.n + i] = d_g.quat[k];
        for (int k = 0; k < 3; ++k) out[(7 + k) * fit.n + i] = d_g.scale[k] * g.scale[k];
        out[10 * fit.n + i] = d_g.opacity * g.opacity * (1 - g.opacity);
    }
}

// Adds the |difference| of colour and alpha, summed over pixels, in every thread.
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

// Leaves the gradients of the parameters, for each view.
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
    // All regions at once, unless their slots are more than there is room for.
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

// Adds up the errors of the blocks that share the views, in each of them.
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

// Keeps the result if it is better than the start; `error` is summed over pixels, before and after.
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

// The views held out, those of all steps, and those held out again, in batches of at most
// kViewsAtOnce.
template <class Fit>
__device__ void fit_one_group(const Fit& fit) {
    const FitConfig& config = fit.in.config;
    const int views_per_step = config.views_per_step;
    const int64_t num_visits = static_cast<int64_t>(config.steps) * views_per_step;
    // Visits of steps count from 0; those of the views held out lie before and after.
    const auto views_at = [&](int64_t visit) {
        const int64_t left = visit < 0            ? -visit
                             : visit < num_visits ? views_per_step - visit % views_per_step
                                                  : num_visits + kHeldOutViews - visit;
        return static_cast<int>(min(static_cast<int64_t>(kViewsAtOnce), left));
    };
    // Of the views of a batch, this block's.
    const auto own_of = [&](int num_views) {
        return fit.view_stride == 1                          ? num_views
               : static_cast<int>(fit.view_rank) < num_views ? 1
                                                             : 0;
    };
    const auto set_cameras = [&](FitCameras& cameras, int64_t first) {
        const int b =
            static_cast<int>(threadIdx.x) - (Fit::kThreads - 32);  // the warp with least to do
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
    double error[2][2] = {{0, 0}, {0, 0}};  // before and after
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

// Powers take long, and all groups take the same steps.
__global__ void steps_kernel(const FitConfig config, FitStep* steps) {
    const unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < static_cast<unsigned>(config.steps)) steps[i] = fit_step(config, static_cast<int>(i));
}

// Counters of the queue, on the device.
struct FitQueue {
    unsigned arrived, next;
    unsigned long long groups_done, loss_sum;
};

template <class Shape, int kBlocks>
__global__ void __launch_bounds__(Shape::kThreads, kBlocks)
    fit_groups_kernel(const FitGroupsInput in, const FitLayout layout, unsigned char* scratch,
                      unsigned num_blocks, FitTeam* teams, FitQueue* queue) {
    __shared__ FitShared s;
    // Blocks are put together as they arrive, so that they only wait for blocks that run or will.
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

// Returns whether so many blocks, at most kBlocks, fit on a multiprocessor; nothing happens where
// they do not.
template <class Shape, int kBlocks>
bool run(const FitGroupsInput& in, uint32_t most, int largest, cudaStream_t stream,
         int blocks = kBlocks) {
    const size_t reserved = sizeof(FitShared) + 1024;  // ours, and the driver's own of each block
    const size_t limit =
        (std::min<size_t>(
            attribute(cudaDevAttrMaxSharedMemoryPerBlockOptin) - sizeof(FitShared),
            attribute(cudaDevAttrMaxSharedMemoryPerMultiprocessor) / blocks - reserved)) /
        16 * 16;
    const size_t most_blocks =
        blocks * static_cast<size_t>(attribute(cudaDevAttrMultiProcessorCount));
    // For a group. Together they need to run at the same time.
    size_t num_blocks = 1;
    if (attribute(cudaDevAttrCooperativeLaunch) != 0)
        num_blocks = std::clamp<size_t>(
            most_blocks / in.jobs.size, 1,
            Shape::kSmall ? std::min(in.config.views_per_step, kViewsAtOnce) : kLargestTeam);
    const size_t num_groups = std::min<size_t>(in.jobs.size, most_blocks / num_blocks);
    const FitSizes sizes{most,       11 + static_cast<size_t>(in.rows.num_sh()),
                         largest,    in.config.loss.dssim > 0,
                         num_blocks, limit};
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
    // Three groups at once on a multiprocessor are quicker than two where it has many in turn.
    const bool are_many = level.num_groups > multiprocessors,
               are_most = level.num_groups >= 6 * multiprocessors;
    const auto run_small = [&] {
        return (are_most && run<FitShape<256, true, 8>, 3>(in, most, largest, stream)) ||
               (are_many && run<FitShape<256, true, 16>, 2>(in, most, largest, stream)) ||
               run<FitShape<512, true, 16>, 1>(in, most, largest, stream) ||
               run<FitShape<256, true, 8>, 3>(in, most, largest, stream, 1);
    };
    // Where multiprocessors have less shared memory, with fewer threads.
    const bool runs = most <= kSmallCount && largest <= kRegion
                          ? run_small()
                          : run<FitShape<512, false, 32>, 1>(in, most, largest, stream) ||
                                run<FitShape<256, false, 16>, 1>(in, most, largest, stream);
    if (!runs)
        throw std::runtime_error("cuda: expected 96 KiB of shared memory in a block, got less");
}

}  // namespace cuda
}  // namespace v3dg
