#pragma once

// The SSIM of a pixel, and the gradient of the L1 loss, for the CPU and CUDA.

#include "math/lanes.h"

namespace v3dg {

constexpr int kSsimRadius = 5;

// Returns the weight of a pixel at distance `offset` along one axis, in the normalised
// Gaussian window of 11 x 11 pixels with sigma 1.5.
template <class T>
V3DG_HD V3DG_INLINE T ssim_weight(int offset) {
    const T weight[kSsimRadius + 1] = {T(0.2660117248617943),   T(0.21300553771125366),
                                       T(0.1093606895097),      T(0.03600077212843082),
                                       T(0.007598758135239184), T(0.001028380084479109)};
    return weight[offset < 0 ? -offset : offset];
}

// Weighted sums over the window of a pixel, for a picture x and its target y.
template <class T>
struct SsimSums {
    T x, y, xx, yy, xy;
};

// The structural similarity (Wang et al. 2004, constants 0.01² and 0.03²), and its
// derivatives with respect to the sums of x, x² and xy.
template <class T>
struct Ssim {
    T value, d_x, d_xx, d_xy;
};

template <class T>
V3DG_HD inline Ssim<T> ssim_of(const SsimSums<T>& s) {
    constexpr T kC1 = T(0.01) * T(0.01), kC2 = T(0.03) * T(0.03);
    const T a1 = 2 * s.x * s.y + kC1, a2 = 2 * (s.xy - s.x * s.y) + kC2;
    const T b1 = s.x * s.x + s.y * s.y + kC1;
    const T b2 = s.xx - s.x * s.x + s.yy - s.y * s.y + kC2;
    Ssim<T> out;
    out.value = a1 * a2 / (b1 * b2);
    out.d_x = 2 * s.y * (a2 - a1) / (b1 * b2) - 2 * s.x * out.value * (1 / b1 - 1 / b2);
    out.d_xx = -out.value / b2;
    out.d_xy = 2 * a1 / (b1 * b2);
    return out;
}

// Returns the gradient of weight * |difference|.
template <class V>
V3DG_HD V3DG_INLINE V l1_vjp(V difference, Lane<V> weight) {
    return difference > V{} ? all_lanes<V>(weight)
                            : (difference < V{} ? all_lanes<V>(-weight) : V{});
}

}  // namespace v3dg
