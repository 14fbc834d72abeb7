#pragma once

// One gaussian over one pixel (or a vector of pixels): the blend step and the way back.
//
// A pixel's transmittance is negative once it has stopped; its magnitude is then the final value.

#include "project/project_math.h"

namespace v3dg {

template <class V>
struct Falloff {
    V dx, dy;    // px from the centre
    V t1, t2;    // L d
    V exponent;  // log2 of alpha before the cut
};

template <class V>
V3DG_HD V3DG_INLINE Falloff<V> falloff_at(V x, V y, V u, V v, V l11, V l12, V l22, V log2_opacity) {
    Falloff<V> f;
    f.dx = x - u;
    f.dy = y - v;
    f.t1 = l11 * f.dx + l12 * f.dy;
    f.t2 = l22 * f.dy;
    f.exponent = log2_opacity - (f.t1 * f.t1 + f.t2 * f.t2);
    return f;
}

// Whether the gaussian counts at all there.
template <class V>
V3DG_HD V3DG_INLINE auto contributes(const Falloff<V>& f) {
    return f.exponent >= all_lanes<V>(Lane<V>(kLog2MinAlpha));
}

template <class V>
V3DG_HD V3DG_INLINE V alpha_of(const Falloff<V>& f) {
    const V alpha = min_of(exp2_in_range(f.exponent), all_lanes<V>(Lane<V>(kMaxAlpha)));
    return contributes(f) ? alpha : V{};
}

// Blends over a pixel with transmittance `t`, updates it and returns the gaussian's weight.
template <class V>
V3DG_HD V3DG_INLINE V blend_weight(V alpha, V& t) {
    const V next = t * (1 - alpha);
    const auto goes_on = next > all_lanes<V>(Lane<V>(kMinTransmittance));
    const V weight = goes_on ? alpha * t : V{};
    t = goes_on ? next : min_of(t, -t);
    return weight;
}

}  // namespace v3dg
