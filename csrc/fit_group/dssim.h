#pragma once

// The D-SSIM of a picture and its gradient, for the loss of a fit.

#include <vector>

namespace v3dg {

// The weights of the terms of the loss. Each term is a mean over pixels and channels.
struct LossWeights {
    float l1;     // absolute difference of premultiplied colour
    float dssim;  // 1 - SSIM of premultiplied colour
    float alpha;  // absolute difference of alpha
    // Weight of the absolute mean differences of cells of 4 x 4 px, relative to `l1`
    // and `alpha`. It counteracts a bias: absolute differences of pixels alone are
    // smallest at the median, which is less than the mean where gaussians are sparse.
    float cells;
};

// Temporary memory of dssim().
struct SsimScratch {
    std::vector<float> maps;
};

// Returns the mean of 1 - SSIM for one channel of width x height pixels, in row-major
// order. Adds `weight` times the gradient with respect to `picture` to `d_picture`. The
// Gaussian window is 11 x 11 with sigma 1.5, and pixels beyond the border are zero. The
// constants are 0.01² and 0.03² (Wang et al. 2004, as used by 3D Gaussian Splatting).
float dssim(const float* picture, const float* target, int width, int height, float weight,
            float* d_picture, SsimScratch& scratch);

}  // namespace v3dg
