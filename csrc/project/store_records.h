#pragma once

// Writes vectors of projected gaussians as records. Included only by sources that are
// compiled once per instruction set.

#include <cstdint>
#include <utility>

#include "frame/record.h"
#include "math/lanes.h"

namespace v3dg {
namespace V3DG_ISA {

// Writes the record of each lane whose bit is set in `lanes`, lane by lane.
template <class T, class V, class I>
V3DG_INLINE void store_each(unsigned lanes, const Ellipse<V>& e, const V color[3],
                            const PixelBox<I>& box, Record<T>* records) {
    for (Record<T>* r = records; lanes != 0; lanes &= lanes - 1, ++r) {
        const int i = __builtin_ctz(lanes);
        const Ellipse<T> mine{e.u[i],    e.v[i], e.l11[i], e.l12[i], e.l22[i], e.log2_opacity[i],
                              e.depth[i]};
        set_ellipse(mine,
                    PixelBox<int>{static_cast<int>(box.x0[i]), static_cast<int>(box.x1[i]),
                                  static_cast<int>(box.y0[i]), static_cast<int>(box.y1[i])},
                    *r);
        for (int c = 0; c < 3; ++c) r->color[c] = color[c][i];
    }
}

#if defined(__SSE2__)

// A vector consists of quarters: parts of four lanes.
constexpr int kQuarters = kLanes<float> / 4;

template <int kQuarter>
V3DG_INLINE __m128 quarter_of(Vec<float> x) {
#if defined(__AVX512F__)
    return _mm512_extractf32x4_ps((__m512)x, kQuarter);
#elif defined(__AVX2__)
    return _mm256_extractf128_ps((__m256)x, kQuarter);
#else
    static_assert(kQuarter == 0, "A vector has four lanes");
    return (__m128)x;
#endif
}

// Interleave the lower, or the upper, two lanes of the quarters of two vectors.
V3DG_INLINE Vec<float> interleave_low(Vec<float> a, Vec<float> b) {
#if defined(__AVX512F__)
    return (Vec<float>)_mm512_unpacklo_ps((__m512)a, (__m512)b);
#elif defined(__AVX2__)
    return (Vec<float>)_mm256_unpacklo_ps((__m256)a, (__m256)b);
#else
    return (Vec<float>)_mm_unpacklo_ps((__m128)a, (__m128)b);
#endif
}
V3DG_INLINE Vec<float> interleave_high(Vec<float> a, Vec<float> b) {
#if defined(__AVX512F__)
    return (Vec<float>)_mm512_unpackhi_ps((__m512)a, (__m512)b);
#elif defined(__AVX2__)
    return (Vec<float>)_mm256_unpackhi_ps((__m256)a, (__m256)b);
#else
    return (Vec<float>)_mm_unpackhi_ps((__m128)a, (__m128)b);
#endif
}

// Four numbers of the records of a vector: quarter q of lane[j] has those of record
// 4 q + j.
struct FourNumbers {
    Vec<float> lane[4];

    V3DG_INLINE FourNumbers(Vec<float> a, Vec<float> b, Vec<float> c, Vec<float> d) {
        // Interleaving pairs twice transposes the quarters.
        const Vec<float> ac_low = interleave_low(a, c), ac_high = interleave_high(a, c),
                         bd_low = interleave_low(b, d), bd_high = interleave_high(b, d);
        lane[0] = interleave_low(ac_low, bd_low);
        lane[1] = interleave_high(ac_low, bd_low);
        lane[2] = interleave_low(ac_high, bd_high);
        lane[3] = interleave_high(ac_high, bd_high);
    }
};

// Writes the records of one quarter whose bits are set in `lanes`. Returns the place of
// the next record. A record that is left out is written, too, and then overwritten.
template <int kQuarter>
V3DG_INLINE Record<float>* store_quarter(unsigned lanes, const FourNumbers (&numbers)[3],
                                         Record<float>* r) {
    for (int j = 0; j < 4; ++j) {
        float* out = &r->u;
        for (int k = 0; k < 3; ++k)
            _mm_storeu_ps(out + 4 * k, quarter_of<kQuarter>(numbers[k].lane[j]));
        r += lanes >> (4 * kQuarter + j) & 1;
    }
    return r;
}

template <int... kQuarter>
V3DG_INLINE void store_quarters(unsigned lanes, const FourNumbers (&numbers)[3], Record<float>* r,
                                std::integer_sequence<int, kQuarter...>) {
    ((r = store_quarter<kQuarter>(lanes, numbers, r)), ...);
}

// Writes the records like store_each(). `records` has room for a record of each lane.
V3DG_INLINE void store_all(unsigned lanes, const Ellipse<Vec<float>>& e, const Vec<float> color[3],
                           const PixelBox<IntVec32>& box, Record<float>* records) {
    static_assert(sizeof *records == 3 * sizeof(__m128) &&
                      offsetof(Record<float>, l22) == 4 * sizeof(float) &&
                      offsetof(Record<float>, color[2]) == 8 * sizeof(float) &&
                      offsetof(Record<float>, x0) == 10 * sizeof(float),
                  "The order of numbers must be that of a Record");
    const Vec<float> columns = (Vec<float>)(box.x0 | box.x1 << 16),
                     rows = (Vec<float>)(box.y0 | box.y1 << 16);
    const FourNumbers numbers[3] = {{e.u, e.v, e.l11, e.l12},
                                    {e.l22, e.log2_opacity, color[0], color[1]},
                                    {color[2], e.depth, columns, rows}};
    store_quarters(lanes, numbers, records, std::make_integer_sequence<int, kQuarters>{});
}

#endif

// Writes the record of each lane whose bit is set in `lanes`. `records` has room for
// `count` records, of which the first lanes are the gaussians.
template <class T, class V, class I>
V3DG_INLINE void store_records(unsigned lanes, [[maybe_unused]] uint64_t count, const Ellipse<V>& e,
                               const V color[3], const PixelBox<I>& box, Record<T>* records) {
#if defined(__SSE2__)
    if constexpr (std::is_same_v<T, float>)
        if (count >= kLanes<float>) return store_all(lanes, e, color, box, records);
#endif
    store_each(lanes, e, color, box, records);
}

}  // namespace V3DG_ISA
}  // namespace v3dg
