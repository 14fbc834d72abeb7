#pragma once

#include <vector>

namespace v3dg {

// Weights of the parts of the loss between two pictures, each a mean over pixels (and channels).
struct LossWeights {
    float l1;     // |difference| of premultiplied colour
    float dssim;  // 1 - SSIM of premultiplied colour
    float alpha;  // |difference| of alpha
};

// Maps that dssim needs in between.
struct SsimScratch {
    std::vector<float> maps;
};

// Mean of 1 - SSIM over one channel of width x height, row major, and `weight` times its gradient
// by `picture`, added to `d_picture`. Gaussian window of 11 x 11, sigma 1.5, zeros beyond the
// border, constants 0.01² and 0.03² (Wang et al. 2004, as 3D Gaussian Splatting uses it).
float dssim(const float* picture, const float* target, int width, int height, float weight,
            float* d_picture, SsimScratch& scratch);

}  // namespace v3dg
