// Fits the groups of a level on CUDA, as many at once as there is memory for their
// target pictures. Meanwhile, the host reports progress and checks for cancellation.

#include "levels/fit_level_cuda.h"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <thread>
#include <vector>

#include "base/event.h"
#include "levels/fit_targets_cuda.h"

namespace v3dg {
namespace cuda {

namespace {

// Maximum size, in bytes, of the target pictures in memory. They also use at most a
// quarter of the free memory.
constexpr size_t kTargetBytes = size_t(1) << 30;
constexpr std::chrono::microseconds kBetweenLooks{50};

// Signals in memory that both the host and a running kernel can access.
class Signals {
  public:
    Signals() {
        check(cudaHostAlloc(reinterpret_cast<void**>(&host_), sizeof(FitSignals),
                            cudaHostAllocMapped),
              "cudaHostAlloc");
        *host_ = FitSignals{};
    }
    Signals(const Signals&) = delete;
    Signals& operator=(const Signals&) = delete;
    ~Signals() { cudaFreeHost(host_); }

    volatile FitSignals& host() { return *host_; }
    FitSignals* device() const {
        return host_;
    }  // the host's address is also valid on
       // the device

  private:
    FitSignals* host_ = nullptr;
};

// Returns the groups as jobs, sorted by descending duration.
std::vector<FitJob> jobs_of(const FitConfig& config, Span<const FitGroup> groups) {
    std::vector<FitJob> jobs(groups.size);
    for (size_t g = 0; g < groups.size; ++g)
        jobs[g] = {.group = groups[g],
                   .first_pixel = 0,
                   .first_view = 0,
                   .error = static_cast<uint32_t>(g),
                   .size = fit_view(config, groups[g], 0).size};
    std::stable_sort(jobs.begin(), jobs.end(), [](const FitJob& a, const FitJob& b) {
        return a.group.count > b.group.count;
    });
    return jobs;
}

size_t target_bytes(const FitConfig& config, const FitJob& job) {
    return num_pictures(config) * job.size * job.size * sizeof(float4);
}

// Fits the jobs whose target pictures fit into memory together.
class LevelFit {
  public:
    LevelFit(const FitConfig& config, const DeviceFitTarget& target,
             const GaussianRows<float>& rows, const FitExtent& extent, FitProgress& progress,
             cudaStream_t stream)
        : config_(config),
          target_(target),
          rows_(rows),
          extent_(extent),
          progress_(progress),
          stream_(stream),
          error_(2 * extent.num_groups, stream),
          steps_(config.steps, stream) {
        make_steps(config, steps_.data(), stream);
    }

    const float* error() const { return error_.data(); }

    void fit(Span<FitJob> jobs) {
        size_t num_pixels = 0, num_views = 0;
        for (FitJob& job : jobs) {
            job.first_pixel = num_pixels;
            job.first_view = num_views;
            num_pixels += target_bytes(config_, job) / sizeof(float4);
            num_views += num_pictures(config_);
        }
        const DeviceBuffer<FitJob> jobs_on_device(jobs, stream_);
        float4* targets = targets_.reserve(num_pixels, stream_);
        FitView* views = views_.reserve(num_views, stream_);
        const Span<const FitJob> on_device{jobs_on_device.data(), jobs.size};
        make_views(config_, on_device, views, stream_);
        draw_targets(config_, jobs, on_device.data, target_, views, targets, frame_, stream_);

        Signals signals;
        const FitGroupsInput in{.config = config_,
                                .stride = visiting_stride(config_),
                                .jobs = on_device,
                                .targets = targets,
                                .views = views,
                                .steps = steps_.data(),
                                .rows = rows_,
                                .error = error_.data(),
                                .signals = signals.device()};
        fit_groups(in, extent_, stream_);
        done_.record(stream_);
        const uint64_t done_before = progress_.groups_done;
        const double loss_before = progress_.loss_sum;
        const auto report = [&] {
            progress_.groups_done = done_before + signals.host().groups_done;
            progress_.loss_sum =
                loss_before + std::ldexp(static_cast<double>(signals.host().loss_sum), -32);
        };
        while (!done_.has_happened("fit_groups_kernel")) {
            report();
            if (progress_.cancel) signals.host().cancel = 1;
            std::this_thread::sleep_for(kBetweenLooks);
        }
        // Two blocks that finish at the same time may write their counts in the wrong
        // order, so write the final count here.
        if (!progress_.cancel) signals.host().groups_done = jobs.size;
        report();
    }

  private:
    const FitConfig& config_;
    const DeviceFitTarget& target_;
    const GaussianRows<float>& rows_;
    const FitExtent extent_;
    FitProgress& progress_;
    const cudaStream_t stream_;
    DeviceBuffer<float> error_;
    const DeviceBuffer<FitStep> steps_;
    DeviceBuffer<float4> targets_;
    DeviceBuffer<FitView> views_;
    Frame frame_;
    Event done_;
};

}  // namespace

void fit_level(const FitConfig& config, Span<const FitGroup> groups, const DeviceFitTarget& target,
               const GaussianRows<float>& rows, float* error, FitProgress& progress,
               Stream stream) {
    if (groups.empty() || progress.cancel) return;
    std::vector<FitJob> jobs = jobs_of(config, groups);
    size_t free_bytes = 0, total_bytes = 0;
    check(cudaMemGetInfo(&free_bytes, &total_bytes), "cudaMemGetInfo");
    size_t budget = std::min(kTargetBytes, free_bytes / 4);
    LevelFit level(config, target, rows, extent_of({jobs.data(), jobs.size()}), progress, stream);
    for (size_t first = 0; first < jobs.size() && !progress.cancel;) {
        size_t last = first, bytes = 0;
        while (last < jobs.size() &&
               (last == first || bytes + target_bytes(config, jobs[last]) <= budget))
            bytes += target_bytes(config, jobs[last++]);
        try {
            level.fit({jobs.data() + first, last - first});
        } catch (const OutOfMemory&) {
            if (last == first + 1) throw;
            budget /= 2;
            continue;
        }
        first = last;
    }
    if (progress.cancel) return;
    check(cudaMemcpyAsync(error, level.error(), 2 * groups.size * sizeof(float),
                          cudaMemcpyDeviceToHost, stream),
          "cudaMemcpyAsync");
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

}  // namespace cuda
}  // namespace v3dg
