#pragma once

// The elementary operations of formulas, for scalars (scalar.h) and for SIMD vectors
// (simd.h). The latter only exist in sources that are compiled per instruction set. A
// formula that uses these operations and `mask ? a : b` works for both.

#include <type_traits>

#include "math/scalar.h"
#include "math/simd.h"

namespace v3dg {

// Converts an integer below 2^24, given as bits, to a floating-point number.
template <class V>
V3DG_HD V3DG_INLINE V float_of_number(Bits<V> bits) {
    if constexpr (std::is_arithmetic<V>::value)
        return static_cast<V>(static_cast<int32_t>(bits));
    else
        return __builtin_convertvector((decltype(V{} < V{}))bits, V);
}

// Returns whether a comparison is true in any lane.
template <class Mask>
V3DG_HD V3DG_INLINE bool is_any(Mask holds) {
    if constexpr (std::is_arithmetic<Mask>::value) return holds != 0;
#ifdef V3DG_ISA
    else
        return bits_of(holds) != 0;
#endif
}

// Returns a / b. Precondition: a and b are neither very small nor very large.
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

// Returns a vector with the same number in every lane. The compiler removes the
// subtraction, because x - 0 equals x for every number. It would not remove an
// addition, because x + 0 changes -0.
template <class V>
V3DG_HD V3DG_INLINE V all_lanes(Lane<V> x) {
    if constexpr (std::is_arithmetic<V>::value) return x;
    return x - V{};
}

// Clamps x to [low, high]. NaN stays NaN. The limits must not be NaN.
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
