#pragma once

// One gaussian over one pixel or a vector of pixels: its falloff, the blend step, and
// the gradients of both.
//
// The transmittance of a pixel becomes negative when the pixel stops; its magnitude is
// then the final transmittance.

#include "frame/image.h"
#include "math/ellipse.h"
#include "math/gaussian.h"

namespace v3dg {

// The falloff of a gaussian at a pixel.
template <class V>
struct Falloff {
    V dx, dy;    // px, relative to the gaussian's centre
    V t1, t2;    // the vector L d
    V exponent;  // log2 of alpha before clamping
};

template <class V>
V3DG_HD V3DG_INLINE Falloff<V> falloff_at(V x, V y, V u, V v, V l11, V l12, V l22, V log2_opacity) {
    Falloff<V> f;
    f.dx = x - u;
    f.dy = y - v;
    f.t1 = l11 * f.dx + l12 * f.dy;
    f.t2 = l22 * f.dy;
    // Pixels of a row share all terms but the last.
    f.exponent = log2_opacity - f.t2 * f.t2 - f.t1 * f.t1;
    return f;
}

// Returns whether the gaussian contributes to the pixel.
template <class V>
V3DG_HD V3DG_INLINE auto contributes(const Falloff<V>& f) {
    return f.exponent >= all_lanes<V>(Lane<V>(kLog2MinAlpha));
}

// Returns alpha. Precondition: contributes(f).
template <class V>
V3DG_HD V3DG_INLINE V capped_alpha_of(const Falloff<V>& f) {
    return min_of(exp2_in_range(f.exponent), all_lanes<V>(Lane<V>(kMaxAlpha)));
}

template <class V>
V3DG_HD V3DG_INLINE V alpha_of(const Falloff<V>& f) {
    const V alpha = capped_alpha_of(f);
    return contributes(f) ? alpha : V{};
}

template <class V>
V3DG_HD V3DG_INLINE V transmittance_behind(V alpha, V t) {
#ifdef __CUDA_ARCH__
    return fma(-alpha, t,
               t);  // an explicit fma, because t - (alpha t) cancels
#else
    return t * (1 - alpha);
#endif
}

// Blend a gaussian over a pixel with transmittance `t`, update `t`, and return the
// gaussian's weight.
template <class V>
V3DG_HD V3DG_INLINE V blend_weight(V alpha, V& t, StopsBehind<Lane<V>> stop) {
    const V next = transmittance_behind(alpha, t);
    const auto is_live = t > V{};
    const V weight = is_live ? alpha * t : V{};
    const V behind = next > all_lanes<V>(stop.transmittance) ? next : -next;
    t = is_live ? behind : t;
    return weight;
}
template <class V>
V3DG_HD V3DG_INLINE V blend_weight(V alpha, V& t, StopsBefore = {}) {
    const V next = transmittance_behind(alpha, t);
    const auto goes_on = next > all_lanes<V>(Lane<V>(kMinTransmittance));
    const V weight = goes_on ? alpha * t : V{};
    t = goes_on ? next : min_of(t, -t);
    return weight;
}

// The final factors of a pixel after blending: the transmittance of the background, and
// the factor of the colour.
template <class T>
struct Finished {
    T transmittance, gain;
};
template <class T>
V3DG_HD V3DG_INLINE Finished<T> finished(T t, float min_transmittance) {
    const bool has_stopped = t < 0;
    if (has_stopped && min_transmittance >= 0) return {T(0), 1 / (1 + t)};
    return {has_stopped ? -t : t, T(1)};
}

// As blend_weight(), for several gaussians, front to back; `before` is the
// transmittance before each. The product of all shows that most pixels do not stop
// among them.
template <int kCount, class T>
V3DG_HD V3DG_INLINE void blend_weights(const T (&alpha)[kCount], T& t, T (&before)[kCount],
                                       T (&weight)[kCount]) {
    T next = t;
    for (int i = 0; i < kCount; ++i) {
        before[i] = next;
        weight[i] = alpha[i] * next;
        next = transmittance_behind(alpha[i], next);
    }
    if (next > T(kMinTransmittance)) {
        t = next;
        return;
    }
    for (int i = 0; i < kCount; ++i) {
        before[i] = t;
        weight[i] = t > 0 ? blend_weight(alpha[i], t) : T(0);
    }
}

// Returns the gradient with respect to the exponent of a gaussian that was blended with
// `alpha` and `weight` where the transmittance was `before`. `by_weight` is the
// gradient with respect to its weight; `behind` is the sum, over all gaussians behind
// it, of weight times gradient by that weight.
template <class V>
V3DG_HD V3DG_INLINE V exponent_vjp(V alpha, V before, V weight, V by_weight, V behind) {
    // Alpha increases the gaussian's weight and attenuates everything behind it.
    const V d_alpha = before * by_weight - quotient_of(behind, 1 - alpha);
    const auto moves = (weight > V{}) & (alpha < all_lanes<V>(Lane<V>(kMaxAlpha)));
    return moves ? Lane<V>(kLn2) * alpha * d_alpha : V{};
}

// Sums over pixels of the gradients with respect to the terms of the exponent.
template <class T>
struct FalloffSums {
    T exponent, t1, t2;
    T t1_dx, t1_dy, t2_dy;  // gradient with respect to t1 times dx, ...
};

// Sums over the pixels of one row, which share dy and t2: the gradient with respect to
// the exponent, and this gradient times t1 and times t1 dx.
template <class T>
struct RowSums {
    T exponent, t1, t1_dx;

    V3DG_HD V3DG_INLINE void add(const Falloff<T>& f, T d_exponent) {
        const T d_t1 = d_exponent * f.t1;
        exponent += d_exponent;
        t1 += d_t1;
        t1_dx += d_t1 * f.dx;
    }

    // Returns the row's contribution to falloff_vjp(); `f` is the falloff at any pixel
    // of the row. The exponent contains -(t1² + t2²), hence the factors -2.
    V3DG_HD V3DG_INLINE FalloffSums<T> of_falloff(const Falloff<T>& f) const {
        FalloffSums<T> sums;
        sums.exponent = exponent;
        sums.t1 = -2 * t1;
        sums.t1_dx = -2 * t1_dx;
        sums.t1_dy = sums.t1 * f.dy;
        sums.t2 = -2 * f.t2 * exponent;
        sums.t2_dy = sums.t2 * f.dy;
        return sums;
    }
};

// Returns the contribution of a pixel to the size of the gradient with respect to the
// centre: the absolute values of both components of falloff_vjp().
template <class V>
V3DG_HD V3DG_INLINE CenterSize<V> size_of_center_vjp(V l11, V l12, V l22, const Falloff<V>& f,
                                                     V d_exponent) {
    const V d_u = 2 * l11 * f.t1 * d_exponent, d_v = 2 * (l12 * f.t1 + l22 * f.t2) * d_exponent;
    return {max_of(d_u, -d_u), max_of(d_v, -d_v)};
}

// Returns the gradient of the ellipse, where t1 = l11 dx + l12 dy and t2 = l22 dy, with
// dx = x - u and dy = y - v.
template <class T>
V3DG_HD V3DG_INLINE Ellipse<T> falloff_vjp(T l11, T l12, T l22, const FalloffSums<T>& d) {
    Ellipse<T> out;
    out.u = -l11 * d.t1;
    out.v = -l12 * d.t1 - l22 * d.t2;
    out.l11 = d.t1_dx;
    out.l12 = d.t1_dy;
    out.l22 = d.t2_dy;
    out.log2_opacity = d.exponent;
    out.depth = T(0);
    return out;
}

// As blend_weight(), for a single pixel that has not stopped. They call add(weight) if
// the weight is positive, and return whether the pixel goes on; `t` stays positive.
// Written as predicates, these conditions are nearly free on a GPU, where a select
// between numbers costs an instruction.
template <class Add>
V3DG_HD V3DG_INLINE bool blend_live(const Falloff<float>& f, float& t, StopsBehind<float> stop,
                                    const Add& add) {
    const float alpha = capped_alpha_of(f);
    if (contributes(f)) {
        add(alpha * t);
        t = transmittance_behind(alpha, t);  // the last use of `t`, so that it is not copied
    }
    return t > stop.transmittance;
}
template <class Add>
V3DG_HD V3DG_INLINE bool blend_live(const Falloff<float>& f, float& t, StopsBefore,
                                    const Add& add) {
    const float alpha = capped_alpha_of(f);
    const bool is_last =
        contributes(f) & !(transmittance_behind(alpha, t) > static_cast<float>(kMinTransmittance));
    if (contributes(f) & !is_last) {
        add(alpha * t);
        t = transmittance_behind(alpha, t);
    }
    return !is_last;
}

// Returns a mask of the cells that a gaussian may reach in a window of 8 x 4 cells, row
// by row. A cell has kPixels adjacent pixels. (u, v) is the gaussian's centre relative
// to that of the first pixel. Both axes have a margin, so that the blend step alone
// decides.
template <int kPixels>
V3DG_HD inline uint32_t reached_cells(float u, float v, float l11, float l12, float l22,
                                      float log2_opacity) {
    // In x, 1 is the width of the window, so that saturation clips to the window.
    constexpr float kScale = 0.125f / kPixels, kMargin = 1e-2f, kReachMargin = 1e-5f;
    const float reach = log2_opacity - static_cast<float>(kLog2MinAlpha) + kReachMargin;
    const float inverse = kScale * rough_reciprocal(l11), slope = -l12 * inverse,
                wider = inverse * (1 + 2e-3f);
    // The first cell is the first one whose last pixel is not left of the ellipse; the
    // end follows the last cell whose first pixel is not right of it. Half a cell is
    // added because both are rounded to integers.
    const float first_u = kScale * u + kScale * (1 - 0.5f * kPixels - kMargin),
                end_u = kScale * u + kScale * (0.5f * kPixels + kMargin);
    uint32_t cells = 0;
    for (int row = 0; row < 4; ++row) {
        const float y = static_cast<float>(row) - v, t = l22 * y;
        // In rows that the ellipse misses this is NaN, which saturates to 0.
        const float half = rough_sqrt(reach - t * t) * wider;
        const float first = saturated_fma(slope, y, first_u - half);
        const float end = fmaxf(saturated_fma(slope, y, end_u + half), first);
        // In the last row an end of 1 shifts the bit out of the word, which leaves the
        // 0 that the subtraction needs.
        const uint32_t row_begin = 1u << (8 * row);
        cells += shifted_by_eighths(row_begin, end) - shifted_by_eighths(row_begin, first);
    }
    return cells;
}

}  // namespace v3dg
