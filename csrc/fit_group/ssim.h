#pragma once

// The SSIM of whole pictures.

#include <cstddef>

#include "math/ssim.h"

namespace v3dg {

// Two pictures with interleaved channels. T is float or double; sums are always
// computed in double.
template <class T>
struct SsimInput {
    const T *picture, *target;  // [height * width * channels]
    size_t height, width;       // both must be larger than kSsimRadius
    size_t channels;
};

// Returns the mean SSIM over all pixels and channels. The Gaussian window is 11 x 11
// with sigma 1.5. Variances are population variances. The border is mirrored without
// repeating the edge. The constants are 0.01² and 0.03². Every run gives the same bits.
//
// Source: Wang et al., Image quality assessment: from error visibility to structural
// similarity, 2004.
template <class T>
double mean_ssim(const SsimInput<T>& in);

}  // namespace v3dg
