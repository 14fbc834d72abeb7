#pragma once

// The codes of a gaussian, relative to the ranges of its cluster. A record of 128 bits
// has all values up to SH degree 0; higher degrees need more bits. docs/format.md
// describes the layout for authors of readers.
//
// Decoding gives the same bits on every device and instruction set, with or without
// floating-point contraction. A step has so few bits that its product with a code is
// exact in float32, so only the sum is rounded.

#include "base/span.h"
#include "math/gaussian.h"

namespace v3dg {

constexpr int kRecordWords = 4;
constexpr int kPageAlignment = 16;  // bytes; allows loading a record with one
                                    // instruction

constexpr uint32_t kMostMean = 4095, kMostScale = 1023, kMostColor = 511, kMostOpacity = 255;
// The code of a rotation. The rotation is multiplied by one of the 24 rotations of a
// cube, chosen such that w is the largest component. The other components are then at
// most sin(22.5 degrees), which is 255 steps. A coded quaternion has the length
// sqrt(kQuatLength2).
constexpr int32_t kZeroQuat = 255, kQuatLength2 = 444016;
constexpr float kQuatStep = 0.0015007235f;  // 1 / sqrt(kQuatLength2)
constexpr float kOpacityStep = 1.0f / 255;
// Limits for the codes of scales, from 2^-64 to 2^64. A code consists of bits of the
// float, which grow approximately like its logarithm.
constexpr uint32_t kLeastScaleBits = 63u << 23, kMostScaleBits = (191u << 23) - 1;
constexpr int kScaleFirstShift = 14, kScaleStepShift = 4;
// The unit of the steps of colours. With this unit, the steps of small ranges are
// normal half floats.
constexpr float kStepUnit = 0.00390625f;  // 2^-8

// The ranges of a cluster, as stored in a page. A half is a float16.
struct ClusterCode {
    float mean_first[3], mean_step[3];  // steps have 12 significant bits
    uint16_t color_first[3];            // halves
    uint16_t color_step[3];             // halves, in units of kStepUnit
    uint16_t scale_first, scale_step;
};
static_assert(sizeof(ClusterCode) == 40, "the file format fixes the size of ClusterCode");

// Returns the number of bytes of a cluster's ranges: a ClusterCode, then three halves
// per SH band above degree 0.
V3DG_HD constexpr int cluster_code_bytes(int sh_degree) {
    return static_cast<int>(sizeof(ClusterCode)) + (6 * sh_degree + 3) / 4 * 4;
}

// Returns the number of 32-bit words per gaussian for SH coefficients above degree 0.
V3DG_HD constexpr int num_sh_words(int sh_degree) { return 2 * sh_degree; }

// Returns the number of bits for one channel (0 brightness, 1 orange, 2 green) of an SH
// coefficient.
V3DG_HD constexpr int sh_bits(int sh_degree, int basis, int channel) {
    return sh_degree == 1   ? 7
           : sh_degree == 2 ? (channel == 0 ? 7 : 6 - channel)
           : channel == 0   ? (basis < 4 ? 5 : 6)
                            : 5 - channel;
}
V3DG_HD constexpr int band_of(int basis) { return basis < 4 ? 1 : basis < 9 ? 2 : 3; }

// Returns the number of bytes of a page. It has the records of gaussians, the codes of
// their SH coefficients, and the ranges of clusters, padded to a multiple of 16.
V3DG_HD constexpr size_t page_bytes(size_t num_gaussians, size_t num_clusters, int sh_degree) {
    return (4 * (kRecordWords + num_sh_words(sh_degree)) * num_gaussians +
            cluster_code_bytes(sh_degree) * num_clusters + kPageAlignment - 1) /
           kPageAlignment * kPageAlignment;
}

// Converts a finite half to a float.
V3DG_HD inline float float_of_half(uint32_t half) {
    const uint32_t exponent = half >> 10 & 31, fraction = half & 1023;
    // A denormal half is `fraction` * 2^-24.
    const float size = exponent == 0 ? static_cast<float>(fraction) * 5.9604645e-8f
                                     : float_of_bits((exponent + 112) << 23 | fraction << 13);
    return half & 0x8000 ? -size : size;
}

// The ranges of a cluster in the form that decoding uses, and the location of its
// codes. An element of a table of ranges has range_bytes() bytes.
struct alignas(16) ClusterRanges {
    float mean_first[3];
    uint32_t scale_first;
    float mean_step[3];
    uint32_t scale_step;
    float color_first[3], color_step[3];
    uint32_t record_base, sh_base;  // explained at Codes
    float sh_step[9];               // [band][channel]
};
V3DG_HD constexpr uint32_t range_bytes(int sh_degree) { return 64 + (3 * sh_degree + 3) / 4 * 16; }
static_assert(range_bytes(3) == sizeof(ClusterRanges),
              "the largest degree must use the whole struct");

// The gaussians of a bundle as codes, on the host or on a device. Row r of cluster c
// has four words of `records`, beginning at index 4 (record_base + r). It has two words
// of `sh` per SH degree, beginning at index 2 (sh_base + sh_stride r). The sums in
// parentheses are modulo 2^32.
struct Codes {
    const uint32_t *records, *sh;
    const unsigned char* ranges;  // [C] ClusterRanges, range_size bytes each
    Span<const int64_t> offset;   // [C + 1] number of gaussians before each cluster
    int sh_degree;
    uint32_t range_size;  // at least range_bytes(sh_degree)
    uint32_t sh_stride;   // at least sh_degree

    V3DG_HD size_t num_clusters() const { return offset.size - 1; }
    V3DG_HD V3DG_INLINE const ClusterRanges& ranges_of(uint32_t cluster) const {
        return *reinterpret_cast<const ClusterRanges*>(ranges + size_t(range_size) * cluster);
    }
    V3DG_HD V3DG_INLINE const uint32_t* record_of(const ClusterRanges& own, uint32_t row) const {
        return records + size_t(kRecordWords) * (own.record_base + row);
    }
    V3DG_HD V3DG_INLINE const uint32_t* sh_of(const ClusterRanges& own, uint32_t row) const {
        return sh + 2 * size_t(own.sh_base + sh_stride * row);
    }
};

// Returns the ranges in the form that decoding uses. `sh_steps` has the halves that
// follow the ClusterCode, three per band.
V3DG_HD inline ClusterRanges ranges_of(const ClusterCode& code, const uint16_t* sh_steps,
                                       int sh_degree) {
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

template <class V>
V3DG_HD V3DG_INLINE V exact_sqrt(V x) {
#ifdef __CUDA_ARCH__
    return __fsqrt_rn(x);  // exactly rounded with any compiler options
#else
    return sqrt_of(x);
#endif
}

// Returns bits [first, first + num_bits) of each lane's word as a number.
template <class V>
V3DG_HD V3DG_INLINE V number_at(Bits<V> word, int first, int num_bits) {
    return float_of_number<V>(word >> first & ((1u << num_bits) - 1));
}

// Decodes one gaussian, or one per lane, and its SH coefficients of degree 0. The
// result is finite if the ranges are valid.
template <class V>
V3DG_HD V3DG_INLINE void decode(const Bits<V> record[kRecordWords], const ClusterRanges& ranges,
                                Gaussian3d<V>& g, V color[3]) {
    const Bits<V> a = record[0], b = record[1], c = record[2], d = record[3];
    const V mean[3] = {number_at<V>(a, 0, 12), number_at<V>(a, 12, 12), number_at<V>(b, 0, 12)};
    const Bits<V> scale[3] = {b >> 12 & 1023u, b >> 22, c & 1023u};
    const V colors[3] = {float_of_number<V>(c >> 28 | (d & 31u) << 4), number_at<V>(d, 5, 9),
                         number_at<V>(d, 14, 9)};
    for (int k = 0; k < 3; ++k) {
        g.mean[k] = ranges.mean_first[k] + mean[k] * ranges.mean_step[k];
        g.scale[k] = float_of_bits(ranges.scale_first + scale[k] * ranges.scale_step);
        color[k] = ranges.color_first[k] + colors[k] * ranges.color_step[k];
    }
    g.opacity = number_at<V>(a, 24, 8) * kOpacityStep;
    const V x = number_at<V>(c, 10, 9) - float(kZeroQuat),
            y = number_at<V>(c, 19, 9) - float(kZeroQuat),
            z = number_at<V>(d, 23, 9) - float(kZeroQuat);
    g.quat[0] =
        // The operands are integers, so the sum is exact.
        exact_sqrt(float(kQuatLength2) - x * x - y * y - z * z) * kQuatStep;
    g.quat[1] = x * kQuatStep;
    g.quat[2] = y * kQuatStep;
    g.quat[3] = z * kQuatStep;
}

// Returns bits [first, first + num_bits) of an array of words.
template <class B>
V3DG_HD V3DG_INLINE B bits_at(const B* words, int first, int num_bits) {
    const int word = first / 32, shift = first % 32;
    B bits = words[word] >> shift;
    if (shift + num_bits > 32) bits |= words[word + 1] << (32 - shift);
    return bits & ((1u << num_bits) - 1);
}

// Decodes the SH coefficients above degree 0 of one gaussian, or of one per lane, with
// three channels each. A code is a signed number n that stands for n |n| steps, so that
// small values have a fine resolution.
template <class V>
V3DG_HD V3DG_INLINE void decode_sh(const Bits<V>* words, const float* step, int sh_degree, V* sh) {
    int first = 0;
#ifdef __CUDA_ARCH__
#pragma unroll
#endif
    for (int basis = 1; basis < num_sh_bases(sh_degree); ++basis) {
        V value[3];
        for (int channel = 0; channel < 3; ++channel) {
            const int num_bits = sh_bits(sh_degree, basis, channel);
            const V code = float_of_number<V>(bits_at(words, first, num_bits)) -
                           static_cast<float>((1 << (num_bits - 1)) - 1);
            value[channel] = code * abs_of(code) * step[3 * (band_of(basis) - 1) + channel];
            first += num_bits;
        }
        const V base = value[0] - value[2];
        V* out = sh + 3 * (basis - 1);
        out[0] = base + value[1];
        out[1] = value[0] + value[2];
        out[2] = base - value[1];
    }
}

// Returns whether all gaussians that these ranges can produce are finite.
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
