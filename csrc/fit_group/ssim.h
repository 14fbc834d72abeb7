#pragma once

#include <cstddef>

#include "math/ssim.h"

namespace v3dg {

// Two pictures of several channels, interleaved. T is float or double; all is computed in double.
template <class T>
struct SsimInput {
    const T *picture, *target;  // [height * width * channels]
    size_t height, width;       // more than kSsimRadius each
    size_t channels;
};

// Mean of SSIM over all pixels and channels. Gaussian window of 11 x 11, sigma 1.5, population
// variances, the border mirrored without repeating the edge, constants 0.01² and 0.03²; the same on
// every run.
//
// Source: Wang et al., Image quality assessment: from error visibility to structural similarity,
// 2004.
template <class T>
double mean_ssim(const SsimInput<T>& in);

}  // namespace v3dg
