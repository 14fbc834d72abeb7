// One step follows another on the caller's stream. Threads with streams of their own make what the
// steps compare with, some steps ahead.

#include "levels/refine_cuts_cuda.h"

#include "base/ahead.h"
#include "base/device_guard.h"
#include "base/event.h"
#include "base/launch.cuh"
#include "base/own_stream.h"
#include "draw/render_backward_cuda.h"
#include "levels/refine_kernels.cuh"

namespace v3dg {
namespace cuda {

namespace {

// The numbers of the target's pictures that are drawn at once, and that are kept ahead of their
// steps.
constexpr unsigned kThreadsAhead = 3, kPicturesAhead = 2 * kThreadsAhead;

// The memory of one picture: colour and alpha.
class Canvas {
  public:
    const PicturePlanes& start(const Camera& camera, cudaStream_t stream) {
        float* color = values_.reserve(4 * num_pixels(camera), stream);
        planes_ = {color, color + 3 * num_pixels(camera), nullptr};
        return planes_;
    }
    const PicturePlanes& planes() const { return planes_; }

  private:
    DeviceBuffer<float> values_;
    PicturePlanes planes_{};
};

ModelPicture picture_of(const GaussianRows<const float>& rows, float filter_px2, bool antialiased,
                        const Camera& camera, const PicturePlanes& planes) {
    const float black[3] = {};
    return {.rows = rows,
            .view = view_of_world<float>(camera),
            .filter_px2 = filter_px2,
            .antialiased = antialiased,
            .image = frame_image(camera.intrinsics<float>(), static_cast<int>(camera.width),
                                 static_cast<int>(camera.height), black, planes)};
}

// Writes the slopes of the loss by the values of a picture.
class Comparison {
  public:
    const PicturePlanes& slopes(const LossWeights& loss, const Camera& camera,
                                const PicturePlanes& picture, const PicturePlanes& target,
                                cudaStream_t stream) {
        const size_t count = num_pixels(camera);
        const unsigned num_blocks = blocks_for(count, kThreads);
        slope_.start(camera, stream);
        double* losses = losses_.reserve(num_blocks, stream);
        float* weight = weight_.reserve(1, stream);
        launch("difference_kernel", difference_kernel, num_blocks, kThreads, 0, stream, picture,
               target, slope_.planes(), count, loss, losses);
        launch("weigh_kernel", weigh_kernel, 1, 32, 0, stream, losses, num_blocks,
               static_cast<double>(count), weight);
        launch("slope_kernel", slope_kernel, num_blocks, kThreads, 0, stream, slope_.planes(),
               count, loss, weight);
        return slope_.planes();
    }

  private:
    Canvas slope_;
    DeviceBuffer<double> losses_;
    DeviceBuffer<float> weight_;
};

// The gaussians of one view, their picture, and its backward pass.
class CutFrame {
  public:
    CutFrame(const FitConfig& config, cudaStream_t stream)
        : config_(config), stream_(stream), background_(3, stream) {}

    // Returns the rows of `count` gaussians, which the caller writes before they are drawn.
    const GaussianRows<float>& start(size_t count, int sh_degree) {
        rows_ = rows_in(values_.reserve(num_values(sh_degree) * count, stream_), count, sh_degree);
        return rows_;
    }
    const PicturePlanes& draw(const Camera& camera) {
        const PicturePlanes& planes = picture_.start(camera, stream_);
        frame_.draw(picture_of(rows_, config_.filter_px2, config_.antialiased, camera, planes),
                    stream_);
        return planes;
    }
    GaussianRows<const float> backward(const PicturePlanes& slopes) {
        const GaussianRows<float> gradient =
            rows_in(gradients_.reserve(num_values(rows_.sh_degree) * rows_.size, stream_),
                    rows_.size, rows_.sh_degree);
        frame_.backward({slopes.color, slopes.alpha, nullptr}, gradient, {}, background_.data(),
                        stream_);
        return gradient;
    }

  private:
    const FitConfig& config_;
    const cudaStream_t stream_;
    DeviceBuffer<float> values_, gradients_, background_;
    GaussianRows<float> rows_{};
    DifferentiableFrame frame_;
    Canvas picture_;
};

// The input of one step: the view, its gaussians, and its target picture.
struct Wanted {
    Camera camera;
    size_t num_gaussians;
    DeviceBuffer<uint32_t> gaussians;
    Canvas picture;
    Event made, used;
};

// Makes the input of steps ahead of them: a step waits for the host as often as it draws, and
// leaves most of the device idle.
class WantedAhead {
  public:
    WantedAhead(const FitConfig& config, const DeviceFitTarget& target, const CutPictures& pictures,
                cudaStream_t stream)
        : config_(config),
          target_(target),
          pictures_(pictures),
          stream_(stream),
          device_(current_device()),
          ahead_(static_cast<uint64_t>(config.steps), kThreadsAhead, kPicturesAhead,
                 [this](uint64_t number) { make(number); }) {}
    // Steps read members until they are done.
    ~WantedAhead() { cudaStreamSynchronize(stream_); }

    const Wanted& wait_for_next() {
        next_ = &wanted_[ahead_.wait_for_next()];
        next_->made.hold_back(stream_);
        return *next_;
    }
    void next_is_used() {
        next_->used.record(stream_);
        ahead_.next_is_used();
    }

  private:
    struct Worker {
        OwnStream stream;
        DifferentiableFrame frame;
        Canvas larger;
    };

    void make(uint64_t number) {
        const DeviceGuard guard(device_);
        Worker& worker = workers_[number % kThreadsAhead];
        Wanted& wanted = wanted_[number % kPicturesAhead];
        const cudaStream_t stream = worker.stream.get();
        wanted.used.hold_back(stream);
        const CutView view = cut_view(pictures_, number);
        const std::vector<uint32_t> gaussians = gaussians_of(pictures_.table, view);
        wanted.camera = view.camera;
        wanted.num_gaussians = gaussians.size();
        wanted.gaussians.copy_from({gaussians.data(), gaussians.size()}, stream);
        const Camera camera = enlarged(view.camera, view.samples);
        const PicturePlanes& larger = worker.larger.start(camera, stream);
        worker.frame.draw(
            picture_of(target_.rows, target_.filter_px2, target_.antialiased, camera, larger),
            stream);
        launch("average_kernel", average_kernel, blocks_for(num_pixels(view.camera), kThreads),
               kThreads, 0, stream, larger, wanted.picture.start(view.camera, stream),
               static_cast<unsigned>(view.camera.width), static_cast<unsigned>(view.camera.height),
               view.samples);
        wanted.made.record(stream);
    }

    const FitConfig& config_;
    const DeviceFitTarget& target_;
    const CutPictures& pictures_;
    const cudaStream_t stream_;
    const int device_;
    Wanted* next_ = nullptr;
    Worker workers_[kThreadsAhead];
    Wanted wanted_[kPicturesAhead];
    Ahead ahead_;  // the last member, because its threads use all others
};

}  // namespace

void refine_cuts(const FitConfig& config, const DeviceFitTarget& target, const CutRows& levels,
                 const CutPictures& pictures, FitProgress& progress, Stream stream) {
    const GaussianRows<float>& rows = levels.rows;
    const size_t num = num_values(rows.sh_degree), num_moments = 2 * num * rows.size;
    const DeviceBuffer<float> moments(num_moments, stream), radius(levels.radius, stream);
    if (num_moments > 0)
        check(cudaMemsetAsync(moments.data(), 0, num_moments * sizeof(float), stream),
              "cudaMemsetAsync");
    check(cudaStreamSynchronize(stream),
          "refine_cuts");  // All streams see the memory that pictures are made of from here on.
    CutFrame frame(config, stream);
    Comparison comparison;
    WantedAhead ahead(config, target, pictures, stream);
    for (int i = 0; i < config.steps && !progress.cancel; ++i) {
        const Wanted& wanted = ahead.wait_for_next();
        const Span<const uint32_t> index{wanted.gaussians.data(), wanted.num_gaussians};
        const unsigned num_blocks = blocks_for(index.size, kGaussiansABlock);
        launch("gather_kernel", gather_kernel, num_blocks, kGaussiansABlock, 0, stream, rows, index,
               frame.start(index.size, rows.sh_degree));
        const PicturePlanes& drawn = frame.draw(wanted.camera);
        const GaussianRows<const float> gradient = frame.backward(
            comparison.slopes(config.loss, wanted.camera, drawn, wanted.picture.planes(), stream));
        launch("move_kernel", move_kernel, num_blocks, kGaussiansABlock, 0, stream, rows, index,
               gradient, radius.data(), target.rows.size, fit_step(config, i), config.beta2,
               Moments{moments.data(), moments.data() + num * rows.size});
        ahead.next_is_used();
        ++progress.groups_done;
    }
    check(cudaStreamSynchronize(stream), "refine_cuts");
}

void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& rows,
                const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress,
                Stream stream) {
    const DeviceBuffer<double> weights(Span<const double>(seen.weight), stream);
    CutFrame frame(config, stream);
    DeviceBuffer<uint32_t> gaussians;
    Canvas slopes;
    for (int i = 0; i < config.steps && !progress.cancel; ++i) {
        const CutView view = cut_view(pictures, static_cast<uint64_t>(i));
        const std::vector<uint32_t> shown = gaussians_of(pictures.table, view);
        for (const uint32_t i : shown) ++seen.num_looks[i];
        gaussians.copy_from({shown.data(), shown.size()}, stream);
        const Span<const uint32_t> index{gaussians.data(), shown.size()};
        const unsigned num_blocks = blocks_for(index.size, kGaussiansABlock);
        launch("gather_in_grey_kernel", gather_in_grey_kernel, num_blocks, kGaussiansABlock, 0,
               stream, rows, index, frame.start(index.size, 0));
        frame.draw(view.camera);
        const PicturePlanes& slope = slopes.start(view.camera, stream);
        const size_t count = num_pixels(view.camera);
        launch("sum_slope_kernel", sum_slope_kernel, blocks_for(count, kThreads), kThreads, 0,
               stream, slope, count);
        launch("weight_kernel", weight_kernel, num_blocks, kGaussiansABlock, 0, stream, index,
               frame.backward(slope), count, weights.data());
        ++progress.groups_done;
    }
    check(cudaMemcpyAsync(seen.weight.data, weights.data(), seen.weight.size * sizeof(double),
                          cudaMemcpyDeviceToHost, stream),
          "weigh_cuts");
    check(cudaStreamSynchronize(stream), "weigh_cuts");
}

}  // namespace cuda
}  // namespace v3dg
