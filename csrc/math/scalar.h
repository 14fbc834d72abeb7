#pragma once

// The elementary operations of formulas, for scalars on the host or a device.

#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "base/host_device.h"

namespace v3dg {

// The two values are stored in variables, because nvcc does not allow calls of the
// host's constexpr functions in device code.
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
// Round up or down to an integer.
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
// Returns 1 / x with a relative error below 1e-6, which suffices for margins. x must be
// positive. Denormal numbers are treated as the smallest normal number.
V3DG_HD inline float rough_reciprocal(float x) {
#ifdef __CUDA_ARCH__
    float inverse;
    // The instruction flushes denormal numbers to zero, and would return infinity.
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
// Returns a * b + c, clamped to [0, 1]. NaN becomes 0.
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
// Returns `bits` shifted left by round(8 x), for x in [0, 1]. A tie may be rounded up
// or down.
V3DG_HD inline uint32_t shifted_by_eighths(uint32_t bits, float x) {
    const float number = 8 * x + 8388608.0f;  // adding 2^23 rounds to an integer
    uint32_t last_bits;
    std::memcpy(&last_bits, &number, sizeof last_bits);
#ifdef __CUDA_ARCH__
    // The instruction only uses the last five bits of the shift.
    return __funnelshift_l(0u, bits, last_bits);
#else
    return bits << (last_bits & 31);
#endif
}
V3DG_HD inline float exp2_in_range(float x) {
#ifdef __CUDA_ARCH__
    float y;  // unlike exp2f(), flushes results below 2^-126 to 0
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return ::exp2f(x);
#endif
}
V3DG_HD inline double exp2_in_range(double x) { return ::exp2(x); }
V3DG_HD inline float log2_of(float x) { return ::log2f(x); }
V3DG_HD inline double log2_of(double x) { return ::log2(x); }
V3DG_HD inline float atan2_of(float y, float x) { return ::atan2f(y, x); }
V3DG_HD inline double atan2_of(double y, double x) { return ::atan2(y, x); }

V3DG_HD inline float float_of_bits(uint32_t bits) {
    float x;
    std::memcpy(&x, &bits, sizeof x);
    return x;
}

// The scalar type of V, which is a scalar or a vector.
template <class V>
struct LaneOf {
    using type = V;
};
template <class V>
using Lane = typename LaneOf<V>::type;

// A 32-bit integer, or a vector with one 32-bit integer per lane of V.
template <class V>
struct BitsOf {
    using type = uint32_t;
};
template <class V>
using Bits = typename BitsOf<V>::type;

}  // namespace v3dg
