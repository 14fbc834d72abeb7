#pragma once

// The kernels of refine_cuts() and weigh_cuts(), for the work before drawing and after
// its backward pass. In kernels over pixels, a row of blocks processes one window. In
// kernels over gaussians, a block processes up to kItemSize gaussians of one cluster.

#include "base/launch.cuh"
#include "levels/cut_windows_cuda.h"
#include "levels/refine_cuts_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kThreads = 256;

// Averages a picture that is `samples` times as wide and high. Launched with one thread
// per pixel of the result.
__global__ void average_kernel(PicturePlanes larger, PicturePlanes picture, unsigned width,
                               unsigned height, int samples) {
    const size_t pixel = size_t(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= size_t(width) * height) return;
    const size_t x = pixel % width, y = pixel / width;
    for (size_t k = 0; k < 3; ++k)
        picture.color[3 * pixel + k] = box_average(larger.color, width, 3, k, x, y, samples);
    picture.alpha[pixel] = box_average(larger.alpha, width, 1, 0, x, y, samples);
}

// The pixel that a thread processes in a window.
struct WindowPixel {
    const FrameImage& image;
    size_t width, height, pixel;

    __device__ WindowPixel(const WindowTables& windows, unsigned window)
        : image(windows.image[window]),
          width(static_cast<size_t>(image.width)),
          height(static_cast<size_t>(image.height)),
          pixel(size_t(blockIdx.x) * kThreads + threadIdx.x) {}
    __device__ bool is_in_window() const { return pixel < width * height; }
};

// A pixel of a window, for kernels in which kCellSide x kCellSide neighbouring threads
// process a cell.
struct CellPixel {
    size_t width, x, y;
    bool is_in_window;

    __device__ explicit CellPixel(const FrameImage& image)
        : width(static_cast<size_t>(image.width)) {
        constexpr size_t kOfCell = kCellSide * kCellSide;
        const size_t thread = size_t(blockIdx.x) * kThreads + threadIdx.x;
        const size_t cell = thread / kOfCell, place = thread % kOfCell, across = num_cells(width);
        x = cell % across * kCellSide + place % kCellSide;
        y = cell / across * kCellSide + place / kCellSide;
        is_in_window = x < width && y < static_cast<size_t>(image.height);
    }
    __device__ size_t pixel() const { return y * width + x; }

    // Sums a value over the threads of the cell. Each of them gets the sum.
    __device__ static float sum(float value) {
#pragma unroll
        for (int offset = kCellSide * kCellSide / 2; offset > 0; offset /= 2)
            value += __shfl_xor_sync(kAllLanes, value, offset);
        return value;
    }
};

// Sums each value over the threads of a block. The first WindowSums::kValues threads
// write the sums.
__device__ inline void write_block_sums(const WindowSums& of_thread, WindowSums& sums) {
    __shared__ double of_warp[WindowSums::kValues][kThreads / 32];
    for (int i = 0; i < WindowSums::kValues; ++i) {
        const double of_lanes = warp_sum(of_thread.values[i]);
        if (threadIdx.x % 32 == 0) of_warp[i][threadIdx.x / 32] = of_lanes;
    }
    __syncthreads();
    if (threadIdx.x >= WindowSums::kValues) return;
    double sum = 0;
    for (const double value : of_warp[threadIdx.x]) sum += value;
    sums.values[threadIdx.x] = sum;
}

// Computes the gradients of pixels as if all windows had the weight 1, and the sums of
// each block. Launched with one thread per pixel. `planes` must have room for
// `most_pixels` pixels per window.
__global__ void __launch_bounds__(kThreads)
    compare_kernel(const WindowTables* windows, LossWeights loss, size_t most_pixels, float* planes,
                   WindowSums* sums_of_block) {
    const unsigned w = blockIdx.y;
    const FrameImage& image = windows->image[w];
    const CellPixel p(image);
    PixelValues pixel{};
    WindowSums sums{};
    if (p.is_in_window) {
        const PixelValues wanted = windows->target[w].at(p.pixel());
        pixel = ReadPlanes{image.planes.color, image.planes.alpha}.at(p.pixel());
        sums.add_pixel(pixel, wanted);
        for (int k = 0; k < 4; ++k) pixel.value[k] -= wanted.value[k];
    }
    PixelValues of_cell{};
    for (int k = 0; k < 4; ++k) of_cell.value[k] = CellPixel::sum(pixel.value[k]);
    if (p.is_in_window) {
        sums.loss() = put_slopes(loss, of_cell, pixel);
        const PicturePlanes slopes = planes_of_window(planes, most_pixels, w);
        for (size_t k = 0; k < 3; ++k) slopes.color[3 * p.pixel() + k] = pixel.value[k];
        slopes.alpha[p.pixel()] = pixel.value[3];
    }
    write_block_sums(sums, sums_of_block[size_t(w) * gridDim.x + blockIdx.x]);
}

// Computes, from the sums of its blocks, the part of the gradient that all pixels of a
// window have in common. Launched with one block per window.
__global__ void __launch_bounds__(kThreads)
    weigh_kernel(const WindowTables* windows, LossWeights loss, float means,
                 const WindowSums* sums_of_block, unsigned num_blocks, WindowSlopes* slopes) {
    const FrameImage& image = windows->image[blockIdx.x];
    __shared__ WindowSums of_window;
    WindowSums sums{};
    for (unsigned i = threadIdx.x; i < num_blocks; i += kThreads)
        sums.add(sums_of_block[size_t(blockIdx.x) * num_blocks + i]);
    write_block_sums(sums, of_window);
    __syncthreads();
    if (threadIdx.x > 0) return;
    slopes[blockIdx.x] =
        slopes_of_window(loss, means, of_window, static_cast<double>(image.width) * image.height);
}

// Adds the gradient of the window's sums to the gradients of its pixels, and multiplies
// the result by the window's weight. Launched with one thread per pixel.
__global__ void __launch_bounds__(kThreads)
    weigh_slopes_kernel(const WindowTables* windows, size_t most_pixels,
                        const WindowSlopes* of_windows, float* planes) {
    const unsigned w = blockIdx.y;
    const WindowPixel p(*windows, w);
    if (!p.is_in_window()) return;
    const PicturePlanes slopes = planes_of_window(planes, most_pixels, w);
    for (int k = 0; k < 3; ++k) {
        float& slope = slopes.color[3 * p.pixel + k];
        slope = of_windows[w].weighed(slope, k);
    }
    slopes.alpha[p.pixel] = of_windows[w].weighed(slopes.alpha[p.pixel], 3);
}

// Writes the gradients of a loss that is the sum of the first channel. Launched with
// one thread per pixel.
__global__ void __launch_bounds__(kThreads)
    sum_slope_kernel(const WindowTables* windows, size_t most_pixels, float* planes) {
    const WindowPixel p(*windows, blockIdx.y);
    if (!p.is_in_window()) return;
    const PicturePlanes out = planes_of_window(planes, most_pixels, blockIdx.y);
    put_sum_slopes(out.color + 3 * p.pixel, out.alpha[p.pixel]);
}

// For each window of a step, the location of the gradients of a cluster's gaussians.
struct ShownCluster {
    const int32_t* item_of_cluster;
    const uint32_t* num_items;
    size_t num_clusters;
    unsigned num_windows;

    // Calls visit(window, row) for each window that shows gaussian `i` of cluster `c`,
    // in the order of windows. `row` is the row of the gaussian's gradient.
    template <class Visit>
    __device__ void for_each_window(size_t c, size_t i, const Visit& visit) const {
        size_t first = 0;
        for (unsigned w = 0; w < num_windows; ++w) {
            const int32_t item = item_of_cluster[w * num_clusters + c];
            if (item >= 0) visit(w, kItemSize * (first + static_cast<size_t>(item)) + i);
            first += num_items[w];
        }
    }
};

// Moves the gaussians of all clusters from `first_cluster` on. The gradients of a
// gaussian are summed over the windows, and the sum overwrites the gradient of the
// first window.
__global__ void __launch_bounds__(kItemSize)
    move_kernel(ShownCluster shown, Span<const int64_t> offset, size_t first_cluster,
                GaussianRows<float> rows, GaussianRows<float> gradient, const float* radius,
                FitStep step, float beta2, Moments moments) {
    const size_t c = first_cluster + blockIdx.x, i = size_t(blockIdx.y) * kItemSize + threadIdx.x,
                 row = static_cast<size_t>(offset[c]) + i;
    if (row >= static_cast<size_t>(offset[c + 1]) || radius[row] == 0) return;
    size_t sum = 0;
    int num_windows = 0;
    shown.for_each_window(c, i, [&](unsigned, size_t of_window) {
        if (num_windows++ == 0)
            sum = of_window;
        else
            add_gradient(GaussianRows<const float>(gradient), of_window, gradient, sum);
    });
    if (num_windows == 0) return;
    move_gaussian(rows, row, GaussianRows<const float>(gradient), sum, radius[row],
                  step_of_windows(step, num_windows), beta2, moments);
}

// Adds how much of each gaussian the windows show, and counts the windows whose cuts
// contain the gaussian.
__global__ void __launch_bounds__(kItemSize)
    weight_kernel(ShownCluster shown, const WindowTables* windows, Span<const int64_t> offset,
                  GaussianRows<const float> gradient, double* weight, int32_t* num_looks) {
    const size_t c = blockIdx.x, i = size_t(blockIdx.y) * kItemSize + threadIdx.x,
                 row = static_cast<size_t>(offset[c]) + i;
    if (row >= static_cast<size_t>(offset[c + 1])) return;
    shown.for_each_window(c, i, [&](unsigned w, size_t of_window) {
        const FrameImage& image = windows->image[w];
        const size_t num_pixels = size_t(image.width) * size_t(image.height);
        weight[row] += blend_weight(gradient.sh[3 * of_window], num_pixels);
        ++num_looks[row];
    });
}

}  // namespace

}  // namespace cuda
}  // namespace v3dg
