#pragma once

// The operations of scalar.h for SIMD vectors that are as wide as the instruction set
// of the compilation allows. They only exist in sources that are compiled once per
// instruction set. They are always inlined, so that the linker cannot use the same code
// for different instruction sets. Formulas include lanes.h instead of this file.

#include <cmath>
#include <cstdint>
#include <cstring>

#include "math/scalar.h"

#ifdef V3DG_ISA

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace v3dg {

#if defined(__AVX512F__)
constexpr int kVectorBytes = 64;
#elif defined(__AVX2__)
constexpr int kVectorBytes = 32;
#else
constexpr int kVectorBytes = 16;
#endif

template <class T>
struct VecOf {
    typedef T type __attribute__((vector_size(kVectorBytes)));
};
template <class T>
using Vec = typename VecOf<T>::type;
template <class T>
constexpr int kLanes = kVectorBytes / static_cast<int>(sizeof(T));

typedef int32_t IntVec32 __attribute__((vector_size(kVectorBytes)));
// The elements are unsigned, because integer arithmetic on this type may wrap.
typedef uint32_t BitsVec32 __attribute__((vector_size(kVectorBytes)));

template <>
struct LaneOf<Vec<float>> {
    using type = float;
};
template <>
struct LaneOf<Vec<double>> {
    using type = double;
};

template <>
struct BitsOf<Vec<float>> {
    using type = BitsVec32;
};
V3DG_INLINE Vec<float> float_of_bits(BitsVec32 bits) { return (Vec<float>)bits; }
V3DG_INLINE Vec<float> abs_of(Vec<float> x) { return (Vec<float>)((BitsVec32)x & 0x7fffffffu); }

V3DG_INLINE Vec<float> sqrt_of(Vec<float> x) {
#if defined(__AVX512F__)
    return (Vec<float>)_mm512_sqrt_ps((__m512)x);
#elif defined(__AVX2__)
    return (Vec<float>)_mm256_sqrt_ps((__m256)x);
#elif defined(__SSE2__)
    return (Vec<float>)_mm_sqrt_ps((__m128)x);
#else
    for (int i = 0; i < kLanes<float>; ++i) x[i] = ::sqrtf(x[i]);
    return x;
#endif
}
V3DG_INLINE Vec<double> sqrt_of(Vec<double> x) {
    for (int i = 0; i < kLanes<double>; ++i) x[i] = ::sqrt(x[i]);
    return x;
}

// Returns a mask in which bit i is set if a comparison is true in lane i. The
// conversion uses the size of a lane, because the type of 64-bit lanes depends on the
// compiler.
template <class Mask>
V3DG_INLINE unsigned bits_of(Mask mask) {
    if constexpr (sizeof(mask[0]) == 4) {
#if defined(__AVX512F__)
        return _mm512_movepi32_mask((__m512i)mask);
#elif defined(__AVX2__)
        return static_cast<unsigned>(_mm256_movemask_ps((__m256)mask));
#elif defined(__SSE2__)
        return static_cast<unsigned>(_mm_movemask_ps((__m128)mask));
#endif
    }
    unsigned bits = 0;
    for (size_t i = 0; i < sizeof mask / sizeof(mask[0]); ++i) bits |= unsigned(mask[i] & 1) << i;
    return bits;
}

// Returns a mask of the lanes' sign bits.
template <class V>
V3DG_INLINE unsigned sign_bits_of(V x) {
    using Mask = decltype(x < x);
#if defined(__SSE2__)
    // The instruction reads only the sign bits.
    if constexpr (sizeof(x[0]) == 4) return bits_of((Mask)x);
#endif
    return bits_of((Mask)x >> (8 * sizeof(x[0]) - 1));
}

// Returns 2^x for x in [-126, 127], with a relative error below 2^-22. For other x, the
// result is undefined. The integer part of x becomes the exponent; a minimax polynomial
// on [-1/2, 1/2] approximates the rest.
V3DG_INLINE Vec<float> exp2_in_range(Vec<float> x) {
    // Adding 1.5 * 2^23 rounds to an integer.
    const Vec<float> magic = Vec<float>{} + 12582912.0f;
    const Vec<float> shifted = x + magic;
    const Vec<float> f = x - (shifted - magic);
    Vec<float> p = f * 0.00132647f + 0.00967151f;
    p = p * f + 0.05550734f;
    p = p * f + 0.24022242f;
    p = p * f + 0.69314698f;
    p = p * f + 1.0f;
    return (Vec<float>)((BitsVec32)p + (((BitsVec32)shifted - (BitsVec32)magic) << 23));
}
V3DG_INLINE Vec<double> exp2_in_range(Vec<double> x) {
    for (int i = 0; i < kLanes<double>; ++i) x[i] = ::exp2(x[i]);
    return x;
}

// Returns log2(x) for positive normal x, with an error below 2e-7 * max(1, |log2 x|).
V3DG_INLINE Vec<float> log2_of(Vec<float> x) {
    // x = m * 2^k with m in [sqrt(1/2), sqrt(2)). The polynomial is fitted to atanh((m
    // - 1) / (m + 1)).
    const IntVec32 bits = (IntVec32)((BitsVec32)x - 0x3f3504f3u);
    const IntVec32 k = bits >> 23;
    const Vec<float> m = (Vec<float>)((bits & 0x007fffff) + 0x3f3504f3);
    const Vec<float> s = (m - 1.0f) / (m + 1.0f);
    const Vec<float> s2 = s * s;
    Vec<float> p = s2 * 0.34070591f + 0.41167448f;
    p = p * s2 + 0.57708354f;
    p = p * s2 + 0.96179667f;
    p = p * s2 + 2.88539008f;
    return s * p + __builtin_convertvector(k, Vec<float>);
}
V3DG_INLINE Vec<double> log2_of(Vec<double> x) {
    for (int i = 0; i < kLanes<double>; ++i) x[i] = ::log2(x[i]);
    return x;
}

V3DG_INLINE Vec<float> atan2_of(Vec<float> y, Vec<float> x) {
    for (int i = 0; i < kLanes<float>; ++i) x[i] = ::atan2f(y[i], x[i]);
    return x;
}
V3DG_INLINE Vec<double> atan2_of(Vec<double> y, Vec<double> x) {
    for (int i = 0; i < kLanes<double>; ++i) x[i] = ::atan2(y[i], x[i]);
    return x;
}

template <class V>
V3DG_INLINE auto to_int(V x) {
    return __builtin_convertvector(x, decltype(x < x));
}
template <class V>
V3DG_INLINE auto floor_to_int(V x) {
    const auto i = to_int(x);
    return i + (x < __builtin_convertvector(i, V));  // a true comparison is -1
}
template <class V>
V3DG_INLINE auto ceil_to_int(V x) {
    const auto i = to_int(x);
    return i - (x > __builtin_convertvector(i, V));
}

V3DG_INLINE float sum_of(Vec<float> x) {
#if defined(__AVX512F__)
    return _mm512_reduce_add_ps((__m512)x);
#else
    float sum = 0;
    for (int i = 0; i < kLanes<float>; ++i) sum += x[i];
    return sum;
#endif
}
V3DG_INLINE double sum_of(Vec<double> x) {
    double sum = 0;
    for (int i = 0; i < kLanes<double>; ++i) sum += x[i];
    return sum;
}

template <class T>
V3DG_INLINE Vec<T> load(const T* p) {
    Vec<T> v;
    std::memcpy(&v, p, sizeof v);
    return v;
}
template <class T>
V3DG_INLINE void store(T* p, Vec<T> v) {
    std::memcpy(p, &v, sizeof v);
}

#if defined(__SSE2__)
// Versions that are a single instruction. They replace the templates in lanes.h.
V3DG_INLINE Vec<float> max_of(Vec<float> a, Vec<float> b) {
#if defined(__AVX512F__)
    return (Vec<float>)_mm512_max_ps((__m512)a, (__m512)b);
#elif defined(__AVX2__)
    return (Vec<float>)_mm256_max_ps((__m256)a, (__m256)b);
#else
    return (Vec<float>)_mm_max_ps((__m128)a, (__m128)b);
#endif
}
V3DG_INLINE Vec<float> min_of(Vec<float> a, Vec<float> b) {
#if defined(__AVX512F__)
    return (Vec<float>)_mm512_min_ps((__m512)a, (__m512)b);
#elif defined(__AVX2__)
    return (Vec<float>)_mm256_min_ps((__m256)a, (__m256)b);
#else
    return (Vec<float>)_mm_min_ps((__m128)a, (__m128)b);
#endif
}
#endif

}  // namespace v3dg

#endif  // V3DG_ISA
