#pragma once

// The few elementary operations that formulas need, for a scalar and, in sources compiled per
// instruction set, for a SIMD vector of them. A formula written with these and `mask ? a : b` runs
// as either.

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <type_traits>

#include "base/host_device.h"

#if defined(V3DG_ISA) && defined(__x86_64__)
#include <immintrin.h>
#endif

namespace v3dg {

// Constants, because nvcc does not let device code call constexpr functions of the host.
template <class T>
constexpr T kLargest = std::numeric_limits<T>::max();
template <class T>
constexpr T kInfinite = std::numeric_limits<T>::infinity();

V3DG_HD inline float sqrt_of(float x) { return ::sqrtf(x); }
V3DG_HD inline double sqrt_of(double x) { return ::sqrt(x); }
V3DG_HD inline float abs_of(float x) { return ::fabsf(x); }
V3DG_HD inline double abs_of(double x) { return ::fabs(x); }
V3DG_HD inline float round_of(float x) { return ::rintf(x); }
V3DG_HD inline double round_of(double x) { return ::rint(x); }
// Rounded up or down to an integer.
V3DG_HD inline int ceil_to_int(float x) {
#ifdef __CUDA_ARCH__
    return __float2int_ru(x);
#else
    return static_cast<int>(::ceilf(x));
#endif
}
V3DG_HD inline int floor_to_int(float x) {
#ifdef __CUDA_ARCH__
    return __float2int_rd(x);
#else
    return static_cast<int>(::floorf(x));
#endif
}
// Exact enough to find a margin by, for positive x: relative error below 1e-6; that of the least
// normal number for what is less.
V3DG_HD inline float rough_reciprocal(float x) {
#ifdef __CUDA_ARCH__
    float inverse;  // without the care of a division for numbers beyond that
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(fmaxf(x, 1.17549435e-38f)));
    return inverse;
#else
    return 1.0f / x;
#endif
}
V3DG_HD inline float rough_sqrt(float x) {
#ifdef __CUDA_ARCH__
    float root;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(root) : "f"(x));
    return root;
#else
    return ::sqrtf(x);
#endif
}
// a b + c cut to [0, 1]; NaN is 0.
V3DG_HD inline float saturated_fma(float a, float b, float c) {
#ifdef __CUDA_ARCH__
    float x;
    asm("fma.rn.ftz.sat.f32 %0, %1, %2, %3;" : "=f"(x) : "f"(a), "f"(b), "f"(c));
    return x;
#else
    const float x = a * b + c;
    return x > 0 ? (x < 1 ? x : 1.0f) : 0.0f;
#endif
}
// `bits` moved to the left by the integer nearest to 8 x, for x in [0, 1]; ties go either way.
V3DG_HD inline uint32_t shifted_by_eighths(uint32_t bits, float x) {
    const float number = 8 * x + 8388608.0f;  // 2^23: adding it rounds to an integer
    uint32_t last_bits;
    std::memcpy(&last_bits, &number, sizeof last_bits);
#ifdef __CUDA_ARCH__
    return __funnelshift_l(0u, bits, last_bits);  // by the last five
#else
    return bits << (last_bits & 31);
#endif
}
V3DG_HD inline float exp2_in_range(float x) {
#ifdef __CUDA_ARCH__
    float y;  // exp2f without its care for results below 2^-126
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return ::exp2f(x);
#endif
}
V3DG_HD inline double exp2_in_range(double x) { return ::exp2(x); }
V3DG_HD inline float log2_of(float x) { return ::log2f(x); }
V3DG_HD inline double log2_of(double x) { return ::log2(x); }

V3DG_HD inline float float_of_bits(uint32_t bits) {
    float x;
    std::memcpy(&x, &bits, sizeof x);
    return x;
}

// The scalar behind V, which is a scalar or a vector of them.
template <class V>
struct LaneOf {
    using type = V;
};
template <class V>
using Lane = typename LaneOf<V>::type;

// 32 bits, or as many a lane of V.
template <class V>
struct BitsOf {
    using type = uint32_t;
};
template <class V>
using Bits = typename BitsOf<V>::type;

// Bits that are a number below 2^24.
template <class V>
V3DG_HD V3DG_INLINE V float_of_number(Bits<V> bits) {
    if constexpr (std::is_arithmetic<V>::value)
        return static_cast<V>(static_cast<int32_t>(bits));
    else
        return __builtin_convertvector((decltype(V{} < V{}))bits, V);
}

#ifdef V3DG_ISA

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
typedef uint32_t BitsVec32
    __attribute__((vector_size(kVectorBytes)));  // for arithmetic that may wrap

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

// Bit i is set where lane i of a comparison holds. Compilers differ in the type of 64-bit lanes.
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

// Bit i is set where the sign of lane i is.
template <class V>
V3DG_INLINE unsigned sign_bits_of(V x) {
    using Mask = decltype(x < x);
#if defined(__SSE2__)
    if constexpr (sizeof(x[0]) == 4) return bits_of((Mask)x);  // which looks at nothing else
#endif
    return bits_of((Mask)x >> (8 * sizeof(x[0]) - 1));
}

// 2^x for x in [-126, 127], relative error below 2^-22; anything for others. The integer part of x
// goes into the exponent, a polynomial of least maximum relative error on [-1/2, 1/2] gives the
// rest.
V3DG_INLINE Vec<float> exp2_in_range(Vec<float> x) {
    const Vec<float> magic =
        Vec<float>{} + 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer
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

// log2 of positive normal x, error below 2e-7 * max(1, |log2 x|).
V3DG_INLINE Vec<float> log2_of(Vec<float> x) {
    // x = m * 2^k with m in [sqrt(1/2), sqrt(2)); then atanh((m - 1) / (m + 1)), fitted.
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

template <class V>
V3DG_INLINE auto to_int(V x) {
    return __builtin_convertvector(x, decltype(x < x));
}
template <class V>
V3DG_INLINE auto floor_to_int(V x) {
    const auto i = to_int(x);
    return i + (x < __builtin_convertvector(i, V));  // a comparison that holds is -1
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

#endif  // V3DG_ISA

#if defined(V3DG_ISA) && defined(__SSE2__)
// What the templates below say, in one instruction.
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

// Whether a comparison holds, in any lane.
template <class Mask>
V3DG_HD V3DG_INLINE bool is_any(Mask holds) {
    if constexpr (std::is_arithmetic<Mask>::value) return holds != 0;
#ifdef V3DG_ISA
    else
        return bits_of(holds) != 0;
#endif
}

// a / b of numbers that are neither tiny nor huge.
template <class V>
V3DG_HD V3DG_INLINE V quotient_of(V a, V b) {
#ifdef __CUDA_ARCH__
    float inverse;  // within 1 ulp
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(b));
    return a * inverse;
#else
    return a / b;
#endif
}

template <class V>
V3DG_HD V3DG_INLINE V max_of(V a, V b) {
    return a > b ? a : b;
}
template <class V>
V3DG_HD V3DG_INLINE V min_of(V a, V b) {
    return a < b ? a : b;
}

// The same number in every lane. Zero is taken away, not added, which leaves every number what it
// is, so that the compiler does not do it.
template <class V>
V3DG_HD V3DG_INLINE V all_lanes(Lane<V> x) {
    if constexpr (std::is_arithmetic<V>::value) return x;
    return x - V{};
}

// x cut to [low, high], which are numbers; what is not a number stays so.
template <class V>
V3DG_HD V3DG_INLINE V cut_to(Lane<V> low, Lane<V> high, V x) {
#ifdef __CUDA_ARCH__
    if constexpr (std::is_same<V, float>::value) {
        asm("max.NaN.f32 %0, %0, %1;" : "+f"(x) : "f"(low));
        asm("min.NaN.f32 %0, %0, %1;" : "+f"(x) : "f"(high));
        return x;
    }
#endif
    return min_of(all_lanes<V>(high), max_of(all_lanes<V>(low), x));
}

}  // namespace v3dg
