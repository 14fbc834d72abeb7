#include "levels/refine_cuts_cuda.h"

#include "base/ahead.h"
#include "base/device_guard.h"
#include "base/launch.cuh"
#include "draw/render_backward_cuda.h"
#include "levels/refine_cuts_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kThreads = 256;
constexpr unsigned kGaussiansABlock =
    64;  // few, so that a level of some thousands spreads over the device
// Pictures of the target that are drawn at once, and that are there ahead of their steps.
constexpr unsigned kThreadsAhead = 3, kPicturesAhead = 2 * kThreadsAhead;

class OwnStream {
  public:
    OwnStream() {
        check(cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking), "cudaStreamCreate");
    }
    // Waits for its work, which reads what belongs to whoever called, also where a step has failed.
    ~OwnStream() {
        cudaStreamSynchronize(stream_);
        cudaStreamDestroy(stream_);
    }
    OwnStream(const OwnStream&) = delete;
    OwnStream& operator=(const OwnStream&) = delete;
    cudaStream_t get() const { return stream_; }

  private:
    cudaStream_t stream_ = nullptr;
};

class Event {
  public:
    Event() { check(cudaEventCreateWithFlags(&event_, cudaEventDisableTiming), "cudaEventCreate"); }
    ~Event() { cudaEventDestroy(event_); }
    Event(const Event&) = delete;
    Event& operator=(const Event&) = delete;
    cudaEvent_t get() const { return event_; }

  private:
    cudaEvent_t event_ = nullptr;
};

size_t num_pixels(const Camera& camera) {
    return static_cast<size_t>(camera.width) * static_cast<size_t>(camera.height);
}

// Colour and alpha of one picture.
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
    return {rows, view_of_world<float>(camera), filter_px2, antialiased,
            frame_image(camera.intrinsics<float>(), static_cast<int>(camera.width),
                        static_cast<int>(camera.height), black, planes)};
}

// A thread a pixel: of a picture that is `samples` times as wide.
__global__ void average_kernel(PicturePlanes larger, PicturePlanes picture, unsigned width,
                               unsigned height, int samples) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= size_t(width) * height) return;
    const size_t x = pixel % width, y = pixel / width;
    for (size_t k = 0; k < 3; ++k)
        picture.color[3 * pixel + k] = box_average(larger.color, width, 3, k, x, y, samples);
    picture.alpha[pixel] = box_average(larger.alpha, width, 1, 0, x, y, samples);
}

// A thread a pixel: how far it is off, and the loss of the block's pixels.
__global__ void difference_kernel(PicturePlanes picture, PicturePlanes target,
                                  PicturePlanes difference, size_t num_pixels, LossWeights loss,
                                  double* loss_of_block) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    double own = 0;
    if (pixel < num_pixels) {
        float* color = difference.color + 3 * pixel;
        for (size_t k = 0; k < 3; ++k)
            color[k] = picture.color[3 * pixel + k] - target.color[3 * pixel + k];
        const float alpha = picture.alpha[pixel] - target.alpha[pixel];
        difference.alpha[pixel] = alpha;
        own = loss_of_pixel(loss, color, alpha);
    }
    __shared__ double of_warp[kThreads / 32];
    own = warp_sum(own);
    if (threadIdx.x % 32 == 0) of_warp[threadIdx.x / 32] = own;
    __syncthreads();
    if (threadIdx.x > 0) return;
    double sum = 0;
    for (const double of : of_warp) sum += of;
    loss_of_block[blockIdx.x] = sum;
}

// One warp: what the picture counts, from the losses of its blocks.
__global__ void weigh_kernel(const double* loss_of_block, unsigned num_blocks, double num_pixels,
                             float* weight) {
    double sum = 0;
    for (unsigned i = threadIdx.x; i < num_blocks; i += 32) sum += loss_of_block[i];
    sum = warp_sum(sum);
    if (threadIdx.x == 0) *weight = weight_of_picture(sum, num_pixels);
}

// A thread a pixel: the slope of the loss in place of its difference.
__global__ void slope_kernel(PicturePlanes difference, size_t num_pixels, LossWeights loss,
                             const float* weight) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= num_pixels) return;
    float* color = difference.color + 3 * pixel;
    for (int k = 0; k < 3; ++k) color[k] = l1_vjp(color[k], loss.l1 / 3 * *weight);
    difference.alpha[pixel] = l1_vjp(difference.alpha[pixel], loss.alpha * *weight);
}

// A thread a pixel: the slope of the sum of one channel.
__global__ void sum_slope_kernel(PicturePlanes slope, size_t num_pixels) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= num_pixels) return;
    for (int k = 0; k < 3; ++k) slope.color[3 * pixel + k] = k == 0 ? 1.0f : 0.0f;
    slope.alpha[pixel] = 0;
}

// A thread a gaussian of the view, which `index` places among all.
__global__ void gather_kernel(GaussianRows<const float> rows, Span<const uint32_t> index,
                              GaussianRows<float> shown) {
    const size_t g = size_t(blockIdx.x) * kGaussiansABlock + threadIdx.x;
    if (g < index.size) copy_gaussian(rows, index[g], shown, g);
}
__global__ void gather_in_grey_kernel(GaussianRows<const float> rows, Span<const uint32_t> index,
                                      GaussianRows<float> shown) {
    const size_t g = size_t(blockIdx.x) * kGaussiansABlock + threadIdx.x;
    if (g < index.size) copy_in_grey(rows, index[g], shown, g);
}
__global__ void weight_kernel(Span<const uint32_t> index, GaussianRows<const float> gradient,
                              size_t num_pixels, double* weight) {
    const size_t g = size_t(blockIdx.x) * kGaussiansABlock + threadIdx.x;
    if (g < index.size) weight[index[g]] += blend_weight(gradient.sh[3 * g], num_pixels);
}
__global__ void move_kernel(GaussianRows<float> rows, Span<const uint32_t> index,
                            GaussianRows<const float> gradient, const float* radius,
                            size_t num_fixed, FitStep step, float beta2, Moments moments) {
    const size_t g = size_t(blockIdx.x) * kGaussiansABlock + threadIdx.x;
    if (g < index.size && index[g] >= num_fixed)
        move_gaussian(rows, index[g], gradient, g, radius[index[g]], step, beta2, moments);
}

// Writes the slope of the loss by each value of the picture.
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

// The gaussians of one view, the picture of them, and the way back.
class CutFrame {
  public:
    CutFrame(const FitConfig& config, cudaStream_t stream)
        : config_(config), stream_(stream), background_(3, stream) {}

    // The rows of so many gaussians, which are written before they are drawn.
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

// What one step needs: the view, its gaussians, and what it should look like.
struct Wanted {
    Camera camera;
    size_t num_gaussians;
    DeviceBuffer<uint32_t> gaussians;
    Canvas picture;
    Event made, used;
};

// Draws what steps need ahead of them: a step waits for the host as often as it draws, and leaves
// most of the device idle.
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
    // Steps read what is here until they are done.
    ~WantedAhead() { cudaStreamSynchronize(stream_); }

    const Wanted& wait_for_next() {
        next_ = &wanted_[ahead_.wait_for_next()];
        check(cudaStreamWaitEvent(stream_, next_->made.get(), 0), "cudaStreamWaitEvent");
        return *next_;
    }
    void next_is_used() {
        check(cudaEventRecord(next_->used.get(), stream_), "cudaEventRecord");
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
        check(cudaStreamWaitEvent(stream, wanted.used.get(), 0), "cudaStreamWaitEvent");
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
        check(cudaEventRecord(wanted.made.get(), stream), "cudaEventRecord");
    }

    const FitConfig& config_;
    const DeviceFitTarget& target_;
    const CutPictures& pictures_;
    const cudaStream_t stream_;
    const int device_;
    Wanted* next_ = nullptr;
    Worker workers_[kThreadsAhead];
    Wanted wanted_[kPicturesAhead];
    Ahead ahead_;  // the last, for its threads use all else
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
          "refine_cuts");  // what pictures are made of is there for all streams
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
