#pragma once

// The D-SSIM of a group's pictures on CUDA. dssim.h defines it.

#include "fit_group/team.cuh"
#include "math/ssim.h"

namespace v3dg {
namespace cuda {

// Computes the gradient of D-SSIM with respect to each picture, which has three planes.
template <class Fit>
__device__ void dssim_backward(const Fit& fit, const FitCameras& cameras, int num_views,
                               const float* pictures, float* d_pictures, float* all_maps) {
    const int size = fit.job.size;
    const uint32_t num_pixels = size * size, count = 3 * num_views * num_pixels;
    const float scale = -fit.in.config.loss.dssim / (3 * static_cast<float>(num_pixels));
    // Adds up the maps inside the window, along rows (step = 1) or columns (step =
    // size).
    const auto blur = [&](const float* maps, uint32_t i, int place, int step, auto& sums) {
#pragma unroll
        for (int k = -kSsimRadius; k <= kSsimRadius; ++k)
            if (place + k >= 0 && place + k < size)
                for (int m = 0; m < static_cast<int>(sizeof(sums) / sizeof(float)); ++m)
                    sums[m] += ssim_weight<float>(k) * maps[m * num_pixels + i + k * step];
    };
    const auto for_each_pixel = [&](const auto& body) {
        for (uint32_t t = fit.first(); t < count; t += fit.stride()) {
            const uint32_t plane = t / num_pixels, i = t - plane * num_pixels;
            body(plane, i, all_maps + static_cast<size_t>(8 * plane) * num_pixels);
        }
        fit.sync();
    };
    const auto target_of = [&](uint32_t plane, uint32_t i) {
        return (&cameras.target[plane / 3]->x)[4 * static_cast<size_t>(i) + plane % 3];
    };
    for_each_pixel([&](uint32_t plane, uint32_t i, float* maps) {
        const float* picture = pictures + static_cast<size_t>(plane) * num_pixels;
        const int column = i % size;
        SsimSums<float> sums{};
#pragma unroll
        for (int k = -kSsimRadius; k <= kSsimRadius; ++k) {
            if (column + k < 0 || column + k >= size) continue;
            const float w = ssim_weight<float>(k), x = picture[i + k], y = target_of(plane, i + k);
            sums.x += w * x;
            sums.y += w * y;
            sums.xx += w * x * x;
            sums.yy += w * y * y;
            sums.xy += w * x * y;
        }
        maps[i] = sums.x;
        maps[num_pixels + i] = sums.y;
        maps[2 * num_pixels + i] = sums.xx;
        maps[3 * num_pixels + i] = sums.yy;
        maps[4 * num_pixels + i] = sums.xy;
    });
    for_each_pixel([&](uint32_t, uint32_t i, float* maps) {
        float sums[5] = {0, 0, 0, 0, 0};
        blur(maps, i, i / size, size, sums);
        const auto ssim = ssim_of<float>(
            {.x = sums[0], .y = sums[1], .xx = sums[2], .yy = sums[3], .xy = sums[4]});
        maps[5 * num_pixels + i] = scale * ssim.d_x;
        maps[6 * num_pixels + i] = scale * ssim.d_xx;
        maps[7 * num_pixels + i] = scale * ssim.d_xy;
    });
    // The backward pass applies the window again, because the window is its own
    // transpose.
    for_each_pixel([&](uint32_t, uint32_t i, float* maps) {
        float sums[3] = {0, 0, 0};
        blur(maps + 5 * num_pixels, i, i % size, 1, sums);
        for (int m = 0; m < 3; ++m) maps[m * num_pixels + i] = sums[m];
    });
    for_each_pixel([&](uint32_t plane, uint32_t i, float* maps) {
        float sums[3] = {0, 0, 0};
        blur(maps, i, i / size, size, sums);
        const size_t pixel = static_cast<size_t>(plane) * num_pixels + i;
        d_pictures[pixel] = sums[0] + 2 * pictures[pixel] * sums[1] + target_of(plane, i) * sums[2];
    });
}

}  // namespace cuda
}  // namespace v3dg
