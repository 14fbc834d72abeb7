#include "pipeline/refine_cuts_cuda.h"

#include "base/launch.cuh"
#include "pipeline/refine_cuts_math.h"
#include "pipeline/render_backward_cuda.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kThreads = 256;
constexpr unsigned kGaussiansABlock = 64;  // few, so that a level of some thousands spreads over the device

// A frame that goes back where it came from, unless drawing failed.
class LentFrame {
  public:
    LentFrame() : frame_(take_frame()) {}
    DifferentiableFrame* operator->() const { return frame_.get(); }
    void give_back() { cuda::give_back(std::move(frame_)); }

  private:
    std::unique_ptr<DifferentiableFrame> frame_;
};

// Colour and alpha of one picture.
class Canvas {
  public:
    const PicturePlanes& start(const Camera& camera, cudaStream_t stream) {
        const size_t num_pixels = static_cast<size_t>(camera.width) * static_cast<size_t>(camera.height);
        float* color = values_.reserve(4 * num_pixels, stream);
        planes_ = {color, color + 3 * num_pixels, nullptr};
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
            frame_image(pinhole_of<float>(camera), static_cast<int>(camera.width),
                        static_cast<int>(camera.height), black, planes)};
}

// A thread a pixel: how far it is off, and the loss of the block's pixels.
__global__ void difference_kernel(PicturePlanes picture, PicturePlanes target, PicturePlanes difference,
                                  unsigned width, unsigned height, int samples, LossWeights loss,
                                  double* loss_of_block) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    double own = 0;
    if (pixel < size_t(width) * height) {
        const size_t x = pixel % width, y = pixel / width;
        float* color = difference.color + 3 * pixel;
        for (size_t k = 0; k < 3; ++k)
            color[k] = picture.color[3 * pixel + k] - box_average(target.color, width, 3, k, x, y, samples);
        const float alpha = picture.alpha[pixel] - box_average(target.alpha, width, 1, 0, x, y, samples);
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

// A thread a gaussian of the view, which `index` places among all.
__global__ void gather_kernel(GaussianRows<const float> rows, Span<const uint32_t> index,
                              GaussianRows<float> shown) {
    const size_t g = size_t(blockIdx.x) * kGaussiansABlock + threadIdx.x;
    if (g < index.size) copy_gaussian(rows, index[g], shown, g);
}
__global__ void move_kernel(GaussianRows<float> rows, Span<const uint32_t> index,
                            GaussianRows<const float> gradient, const float* radius, size_t num_fixed,
                            FitStep step, float beta2, Moments moments) {
    const size_t g = size_t(blockIdx.x) * kGaussiansABlock + threadIdx.x;
    if (g < index.size && index[g] >= num_fixed)
        move_gaussian(rows, index[g], gradient, g, radius[index[g]], step, beta2, moments);
}

// Writes the slope of the loss by each value of the picture.
class Comparison {
  public:
    const PicturePlanes& slopes(const FitConfig& config, int samples, const Camera& camera,
                                const PicturePlanes& picture, const PicturePlanes& target,
                                cudaStream_t stream) {
        const auto width = static_cast<unsigned>(camera.width), height = static_cast<unsigned>(camera.height);
        const size_t num_pixels = size_t(width) * height;
        const unsigned num_blocks = blocks_for(num_pixels, kThreads);
        slope_.start(camera, stream);
        double* losses = losses_.reserve(num_blocks, stream);
        float* weight = weight_.reserve(1, stream);
        launch("difference_kernel", difference_kernel, num_blocks, kThreads, 0, stream, picture, target,
               slope_.planes(), width, height, samples, config.loss, losses);
        launch("weigh_kernel", weigh_kernel, 1, 32, 0, stream, losses, num_blocks,
               static_cast<double>(num_pixels), weight);
        launch("slope_kernel", slope_kernel, num_blocks, kThreads, 0, stream, slope_.planes(), num_pixels,
               config.loss, weight);
        return slope_.planes();
    }

  private:
    Canvas slope_;
    DeviceBuffer<double> losses_;
    DeviceBuffer<float> weight_;
};

}  // namespace

void refine_cuts(const FitConfig& config, const DeviceFitTarget& target, const CutRows& levels,
                 Span<const CutView> views, FitProgress& progress, Stream stream) {
    const GaussianRows<float>& rows = levels.rows;
    const size_t num = num_values(rows), num_moments = 2 * num * rows.size;
    const DeviceBuffer<float> moments(num_moments, stream), radius(levels.radius, stream),
        background(3, stream);
    if (num_moments > 0)
        check(cudaMemsetAsync(moments.data(), 0, num_moments * sizeof(float), stream), "cudaMemsetAsync");
    DeviceBuffer<uint32_t> indices;
    DeviceBuffer<float> shown_values, gradients;
    LentFrame of_target, of_cut;
    Canvas wanted, drawn;
    Comparison comparison;
    for (size_t i = 0; i < views.size && !progress.cancel; ++i) {
        const Camera& camera = views[i].camera;
        const int samples = samples_of(config, camera);
        const Camera larger = enlarged(camera, samples);
        of_target->draw(picture_of(target.rows, target.filter_px2, target.antialiased, larger,
                                   wanted.start(larger, stream)),
                        stream);

        const std::vector<uint32_t> gaussians = gaussians_of(levels, views[i]);
        const size_t count = gaussians.size();
        const Span<const uint32_t> index{indices.copy_from({gaussians.data(), count}, stream), count};
        const GaussianRows<float> shown =
            rows_in(shown_values.reserve(num * count, stream), count, rows.sh_degree);
        const unsigned num_blocks = blocks_for(count, kGaussiansABlock);
        launch("gather_kernel", gather_kernel, num_blocks, kGaussiansABlock, 0, stream, rows, index, shown);
        of_cut->draw(
            picture_of(shown, config.filter_px2, config.antialiased, camera, drawn.start(camera, stream)),
            stream);
        const PicturePlanes& slopes =
            comparison.slopes(config, samples, camera, drawn.planes(), wanted.planes(), stream);
        const GaussianRows<float> gradient =
            rows_in(gradients.reserve(num * count, stream), count, rows.sh_degree);
        of_cut->backward({slopes.color, slopes.alpha, nullptr}, gradient, {}, background.data(), stream);
        launch("move_kernel", move_kernel, num_blocks, kGaussiansABlock, 0, stream, rows, index, gradient,
               radius.data(), target.rows.size, fit_step(config, static_cast<int>(i)), config.beta2,
               Moments{moments.data(), moments.data() + num * rows.size});
        ++progress.groups_done;
    }
    check(cudaStreamSynchronize(stream), "refine_cuts");
    of_target.give_back();
    of_cut.give_back();
}

}  // namespace cuda
}  // namespace v3dg
