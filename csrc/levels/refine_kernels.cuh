#pragma once

// The kernels of refine_cuts and weigh_cuts: they handle the pixels of a picture and the gaussians
// of a view before and after drawing and its backward pass.

#include "base/launch.cuh"
#include "frame/image.h"
#include "levels/refine_cuts_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kThreads = 256;
constexpr unsigned kGaussiansABlock = 64;  // few, so that some thousands spread over the device

// Averages a picture that is `samples` times as wide, a thread a pixel.
__global__ void average_kernel(PicturePlanes larger, PicturePlanes picture, unsigned width,
                               unsigned height, int samples) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= size_t(width) * height) return;
    const size_t x = pixel % width, y = pixel / width;
    for (size_t k = 0; k < 3; ++k)
        picture.color[3 * pixel + k] = box_average(larger.color, width, 3, k, x, y, samples);
    picture.alpha[pixel] = box_average(larger.alpha, width, 1, 0, x, y, samples);
}

// Writes the differences of pixels, a thread each, and the loss of each block.
__global__ void difference_kernel(PicturePlanes picture, PicturePlanes target,
                                  PicturePlanes difference, size_t num_pixels, LossWeights loss,
                                  double* loss_of_block) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    double pixel_loss = 0;
    if (pixel < num_pixels) {
        float* color = difference.color + 3 * pixel;
        for (size_t k = 0; k < 3; ++k)
            color[k] = picture.color[3 * pixel + k] - target.color[3 * pixel + k];
        const float alpha = picture.alpha[pixel] - target.alpha[pixel];
        difference.alpha[pixel] = alpha;
        pixel_loss = loss_of_pixel(loss, color, alpha);
    }
    __shared__ double of_warp[kThreads / 32];
    pixel_loss = warp_sum(pixel_loss);
    if (threadIdx.x % 32 == 0) of_warp[threadIdx.x / 32] = pixel_loss;
    __syncthreads();
    if (threadIdx.x > 0) return;
    double sum = 0;
    for (const double warp_loss : of_warp) sum += warp_loss;
    loss_of_block[blockIdx.x] = sum;
}

// Computes the weight of the picture from the losses of its blocks; called by one warp.
__global__ void weigh_kernel(const double* loss_of_block, unsigned num_blocks, double num_pixels,
                             float* weight) {
    double sum = 0;
    for (unsigned i = threadIdx.x; i < num_blocks; i += 32) sum += loss_of_block[i];
    sum = warp_sum(sum);
    if (threadIdx.x == 0) *weight = weight_of_picture(sum, num_pixels);
}

// Puts the slopes of the loss in place of the differences, a thread a pixel.
__global__ void slope_kernel(PicturePlanes difference, size_t num_pixels, LossWeights loss,
                             const float* weight) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= num_pixels) return;
    put_slopes(loss, *weight, difference.color + 3 * pixel, difference.alpha[pixel]);
}

// Writes the slopes of the sum of one channel, a thread a pixel.
__global__ void sum_slope_kernel(PicturePlanes slope, size_t num_pixels) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= num_pixels) return;
    put_sum_slopes(slope.color + 3 * pixel, slope.alpha[pixel]);
}

// These handle a gaussian of the view a thread; `index` has its row among all.
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

}  // namespace

}  // namespace cuda
}  // namespace v3dg
