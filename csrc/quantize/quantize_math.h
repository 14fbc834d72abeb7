#pragma once

// What the codes of a gaussian mean: 128 bits for all that SH degree 0 needs, more words for the higher
// degrees, relative to the ranges of its cluster. docs/format.md has the layout for those who write a reader.
//
// Every device and every instruction set decodes to the same bits, whether products are contracted into sums
// or not: a step has so few bits that its product with a code is exact in float32, so there is one rounding.

#include "math/gaussian.h"

namespace v3dg {

constexpr int kRecordWords = 4;
constexpr int kPageAlignment = 16;  // bytes: a record in one load

constexpr uint32_t kMostMean = 4095, kMostScale = 1023, kMostColor = 511, kMostOpacity = 255;
// A rotation is turned by one of the 24 of a cube until the largest component is w; the others are then at
// most sin(22.5 degrees), which is 255 steps. A quaternion of codes has the length sqrt(kQuatLength2).
constexpr int32_t kZeroQuat = 255, kQuatLength2 = 444016;
constexpr float kQuatStep = 0.0015007235f;  // 1 / sqrt(kQuatLength2)
// Scales are coded by the bits of the float, which rise about as the logarithm does: from 2^-64 to 2^64.
constexpr uint32_t kLeastScaleBits = 63u << 23, kMostScaleBits = (191u << 23) - 1;
constexpr int kScaleFirstShift = 14, kScaleStepShift = 4;
// So that the steps of small ranges are normal numbers in 16 bits.
constexpr float kStepUnit = 0.00390625f;  // 2^-8

// Ranges of a cluster, as they are in a page. Halves are float16.
struct ClusterCode {
    float mean_first[3], mean_step[3];  // the step has 12 significant bits
    uint16_t color_first[3];            // halves
    uint16_t color_step[3];             // halves, in kStepUnit
    uint16_t scale_first, scale_step;
};
static_assert(sizeof(ClusterCode) == 40, "a format of files");

// Bytes of a cluster's ranges: a ClusterCode, and three halves for each band above the constant one.
V3DG_HD constexpr int cluster_code_bytes(int sh_degree) {
    return static_cast<int>(sizeof(ClusterCode)) + (6 * sh_degree + 3) / 4 * 4;
}

// Words of a gaussian's coefficients above the constant one.
V3DG_HD constexpr int num_sh_words(int sh_degree) { return 2 * sh_degree; }

// Bits of a coefficient's brightness (channel 0), orange (1) and green (2).
V3DG_HD constexpr int sh_bits(int sh_degree, int basis, int channel) {
    return sh_degree == 1   ? 7
           : sh_degree == 2 ? (channel == 0 ? 7 : 6 - channel)
           : channel == 0   ? (basis < 4 ? 5 : 6)
                            : 5 - channel;
}
V3DG_HD constexpr int band_of(int basis) { return basis < 4 ? 1 : basis < 9 ? 2 : 3; }

// Bytes of a page: codes of gaussians, those of their coefficients, ranges of clusters; filled up to 16.
V3DG_HD constexpr size_t page_bytes(size_t num_gaussians, size_t num_clusters, int sh_degree) {
    return (4 * (kRecordWords + num_sh_words(sh_degree)) * num_gaussians +
            cluster_code_bytes(sh_degree) * num_clusters + kPageAlignment - 1) /
           kPageAlignment * kPageAlignment;
}

V3DG_HD inline float float_of_bits(uint32_t bits) {
    float x;
    std::memcpy(&x, &bits, sizeof x);
    return x;
}

// Of a finite half.
V3DG_HD inline float float_of_half(uint32_t half) {
    const uint32_t exponent = half >> 10 & 31, fraction = half & 1023;
    const float size = exponent == 0 ? static_cast<float>(fraction) * 5.9604645e-8f  // 2^-24
                                     : float_of_bits((exponent + 112) << 23 | fraction << 13);
    return half & 0x8000 ? -size : size;
}

// The ranges of a cluster, ready to decode with.
struct ClusterRanges {
    float mean_first[3], mean_step[3], color_first[3], color_step[3];
    uint32_t scale_first, scale_step;
    float sh_step[9];  // band by band, three channels each
};

// `sh_steps` are the halves behind the code, three a band.
V3DG_HD inline ClusterRanges ranges_of(const ClusterCode& code, const uint16_t* sh_steps, int sh_degree) {
    ClusterRanges out{};
    for (int k = 0; k < 3; ++k) {
        out.mean_first[k] = code.mean_first[k];
        out.mean_step[k] = code.mean_step[k];
        out.color_first[k] = float_of_half(code.color_first[k]);
        out.color_step[k] = float_of_half(code.color_step[k]) * kStepUnit;
    }
    out.scale_first = kLeastScaleBits + (uint32_t(code.scale_first) << kScaleFirstShift);
    out.scale_step = uint32_t(code.scale_step) << kScaleStepShift;
    for (int k = 0; k < 3 * sh_degree; ++k) out.sh_step[k] = float_of_half(sh_steps[k]) * kStepUnit;
    return out;
}

V3DG_HD inline float exact_sqrt(float x) {
#ifdef __CUDA_ARCH__
    return __fsqrt_rn(x);  // whatever the file is compiled with
#else
    return ::sqrtf(x);
#endif
}

// One gaussian with the coefficients of its constant basis. A finite result follows from ranges that
// are_valid().
V3DG_HD inline void decode(const uint32_t record[kRecordWords], const ClusterRanges& ranges,
                           Gaussian3d<float>& g, float color[3]) {
    const uint32_t a = record[0], b = record[1], c = record[2], d = record[3];
    const uint32_t mean[3] = {a & 4095, a >> 12 & 4095, b & 4095};
    const uint32_t scale[3] = {b >> 12 & 1023, b >> 22, c & 1023};
    const uint32_t colors[3] = {c >> 28 | (d & 31) << 4, d >> 5 & 511, d >> 14 & 511};
    const int32_t x = int32_t(c >> 10 & 511) - kZeroQuat, y = int32_t(c >> 19 & 511) - kZeroQuat,
                  z = int32_t(d >> 23) - kZeroQuat;
    for (int k = 0; k < 3; ++k) {
        g.mean[k] = ranges.mean_first[k] + static_cast<float>(mean[k]) * ranges.mean_step[k];
        g.scale[k] = float_of_bits(ranges.scale_first + scale[k] * ranges.scale_step);
        color[k] = ranges.color_first[k] + static_cast<float>(colors[k]) * ranges.color_step[k];
    }
    g.opacity = static_cast<float>(a >> 24) * (1.0f / 255);
    g.quat[0] = exact_sqrt(static_cast<float>(kQuatLength2 - x * x - y * y - z * z)) * kQuatStep;
    g.quat[1] = static_cast<float>(x) * kQuatStep;
    g.quat[2] = static_cast<float>(y) * kQuatStep;
    g.quat[3] = static_cast<float>(z) * kQuatStep;
}

// `num_bits` bits of words, from bit `first` on.
V3DG_HD inline uint32_t bits_at(const uint32_t* words, int first, int num_bits) {
    const int word = first / 32, shift = first % 32;
    uint32_t bits = words[word] >> shift;
    if (shift + num_bits > 32) bits |= words[word + 1] << (32 - shift);
    return bits & ((1u << num_bits) - 1);
}

// The coefficients above the constant basis, three channels each. A code is a signed number whose square
// counts, so that small values have small steps.
V3DG_HD inline void decode_sh(const uint32_t* words, const float* step, int sh_degree, float* sh) {
    int first = 0;
    for (int basis = 1; basis < num_sh_bases(sh_degree); ++basis) {
        float value[3];
        for (int channel = 0; channel < 3; ++channel) {
            const int num_bits = sh_bits(sh_degree, basis, channel);
            const int32_t code = int32_t(bits_at(words, first, num_bits)) - ((1 << (num_bits - 1)) - 1);
            value[channel] = static_cast<float>(code < 0 ? -code * code : code * code) *
                             step[3 * (band_of(basis) - 1) + channel];
            first += num_bits;
        }
        const float base = value[0] - value[2];
        float* out = sh + 3 * (basis - 1);
        out[0] = base + value[1];
        out[1] = value[0] + value[2];
        out[2] = base - value[1];
    }
}

// Whether all that can be decoded with these ranges is finite.
V3DG_HD inline bool are_valid(const ClusterCode& code, const uint16_t* sh_steps, int sh_degree) {
    bool valid = true;
    const auto is_finite_half = [](uint32_t half) { return (half >> 10 & 31) != 31; };
    for (int k = 0; k < 3; ++k) {
        const float first = code.mean_first[k], range = code.mean_step[k] * float(kMostMean);
        valid &= abs_of(first) <= kLargest<float> && range >= 0 && range <= kLargest<float> &&
                 abs_of(first + range) <= kLargest<float> && is_finite_half(code.color_first[k]) &&
                 is_finite_half(code.color_step[k]);
    }
    valid &= (uint32_t(code.scale_first) << kScaleFirstShift) +
                 kMostScale * (uint32_t(code.scale_step) << kScaleStepShift) <=
             kMostScaleBits - kLeastScaleBits;
    for (int k = 0; k < 3 * sh_degree; ++k) valid &= is_finite_half(sh_steps[k]);
    return valid;
}

}  // namespace v3dg
