#pragma once

// Formulas for one gaussian at one pixel or at a vector of pixels: the falloff, the
// blend step, and their gradients.
//
// The sign of a transmittance marks stopped pixels: it becomes negative, and its
// absolute value is the final transmittance.

#include "frame/image.h"
#include "math/ellipse.h"
#include "math/gaussian.h"

namespace v3dg {

// The falloff of a gaussian at a pixel.
template <class V>
struct Falloff {
    V dx, dy;    // px, from the gaussian's centre to the pixel's centre
    V t1, t2;    // the vector L d, where d is (dx, dy)
    V exponent;  // log2 of alpha before clamping
};

template <class V>
V3DG_HD V3DG_INLINE Falloff<V> falloff_at(V x, V y, V u, V v, V l11, V l12, V l22, V log2_opacity) {
    Falloff<V> f;
    f.dx = x - u;
    f.dy = y - v;
    f.t1 = l11 * f.dx + l12 * f.dy;
    f.t2 = l22 * f.dy;
    // The terms are ordered so that the pixels of a row share all but the last one.
    f.exponent = log2_opacity - f.t2 * f.t2 - f.t1 * f.t1;
    return f;
}

// Returns whether alpha is large enough to be blended.
template <class V>
V3DG_HD V3DG_INLINE auto contributes(const Falloff<V>& f) {
    return f.exponent >= all_lanes<V>(Lane<V>(kLog2MinAlpha));
}

// Returns alpha, at most kMaxAlpha. Precondition: contributes(f).
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
               t);  // fma, because t - alpha * t would cancel
#else
    return t * (1 - alpha);
#endif
}

// Blend a gaussian over a pixel: update the transmittance `t`, and return the
// gaussian's blend weight. Stopped pixels are not changed.
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

// Factors that give the final colour of a pixel: `transmittance` multiplies the
// background, and `gain` the blended colour.
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

// Like blend_weight(), but blends several gaussians, front to back. `before` receives
// the transmittance in front of each gaussian. Usually no pixel stops, and a single
// comparison after the last gaussian shows this.
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
    if (!(t > 0)) {
        for (int i = 0; i < kCount; ++i) {
            before[i] = t;
            weight[i] = 0;
        }
        return;
    }
    for (int i = 0; i < kCount; ++i) {
        before[i] = t;
        weight[i] = t > 0 ? blend_weight(alpha[i], t) : T(0);
    }
}

// Returns the gradient with respect to the exponent of a gaussian that was blended with
// `alpha` and `weight`. `before` is the transmittance in front of the gaussian, and
// `by_weight` the gradient with respect to its weight. `behind` is the sum of weight
// times by_weight over all gaussians behind it.
template <class V>
V3DG_HD V3DG_INLINE V exponent_vjp(V alpha, V before, V weight, V by_weight, V behind) {
    // A larger alpha increases the gaussian's own weight, and reduces the weights of
    // all gaussians behind it.
    const V d_alpha = before * by_weight - quotient_of(behind, 1 - alpha);
    const auto moves = (weight > V{}) & (alpha < all_lanes<V>(Lane<V>(kMaxAlpha)));
    return moves ? Lane<V>(kLn2) * alpha * d_alpha : V{};
}

// Gradients with respect to the terms of the exponent, summed over pixels.
template <class T>
struct FalloffSums {
    T exponent, t1, t2;
    T t1_dx, t1_dy, t2_dy;  // sums over pixels of the gradient of t1 times dx, of t1
                            // times dy, and of t2 times dy
};

// Sums over the pixels of one row, in which dy and t2 are equal. They are sums of the
// gradient with respect to the exponent, of this gradient times t1, and of it times t1
// dx.
template <class T>
struct RowSums {
    T exponent, t1, t1_dx;

    V3DG_HD V3DG_INLINE void add(const Falloff<T>& f, T d_exponent) {
        const T d_t1 = d_exponent * f.t1;
        exponent += d_exponent;
        t1 += d_t1;
        t1_dx += d_t1 * f.dx;
    }

    // Converts the sums of the row to the input of falloff_vjp(). `f` is the falloff at
    // any pixel of the row. The factors are -2, because the exponent contains -(t1² +
    // t2²).
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

// Returns one pixel's contribution to CenterSize: the absolute values of the gradient
// with respect to the centre.
template <class V>
V3DG_HD V3DG_INLINE CenterSize<V> size_of_center_vjp(V l11, V l12, V l22, const Falloff<V>& f,
                                                     V d_exponent) {
    const V d_u = 2 * l11 * f.t1 * d_exponent, d_v = 2 * (l12 * f.t1 + l22 * f.t2) * d_exponent;
    return {max_of(d_u, -d_u), max_of(d_v, -d_v)};
}

// Returns the gradient of the ellipse. The formulas follow from t1 = l11 dx + l12 dy
// and t2 = l22 dy, with dx = x - u and dy = y - v.
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

// Like blend_weight(), but for a single pixel that has not stopped. If the weight is
// positive, calls add(weight). Returns whether the pixel continues; `t` stays positive.
// This form is for GPUs, where predicated branches are nearly free, but selecting
// between two values costs an instruction.
template <class Add>
V3DG_HD V3DG_INLINE bool blend_live(const Falloff<float>& f, float& t, StopsBehind<float> stop,
                                    const Add& add) {
    const float alpha = capped_alpha_of(f);
    if (contributes(f)) {
        add(alpha * t);
        // Overwrite `t`: unlike with StopsBefore, its old value is not needed.
        t = transmittance_behind(alpha, t);
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
// by row. A cell consists of kPixels adjacent pixels. (u, v) is the gaussian's centre
// relative to the centre of the window's first pixel. The mask has a margin on both
// axes, so that only the blend step decides about a pixel.
template <int kPixels>
V3DG_HD inline uint32_t reached_cells(float u, float v, float l11, float l12, float l22,
                                      float log2_opacity) {
    // x is divided by the window's width, so that saturating it to [0, 1] clips it to
    // the window.
    constexpr float kScale = 0.125f / kPixels, kMargin = 1e-2f, kReachMargin = 1e-5f;
    const float reach = log2_opacity - static_cast<float>(kLog2MinAlpha) + kReachMargin;
    const float inverse = kScale * rough_reciprocal(l11), slope = -l12 * inverse,
                wider = inverse * (1 + 2e-3f);
    // The range begins with the first cell whose last pixel is not to the left of the
    // ellipse. It ends with the last cell whose first pixel is not to the right of it.
    // Both numbers are rounded to the nearest integer later, so half a cell is added.
    const float first_u = kScale * u + kScale * (1 - 0.5f * kPixels - kMargin),
                end_u = kScale * u + kScale * (0.5f * kPixels + kMargin);
    uint32_t cells = 0;
    for (int row = 0; row < 4; ++row) {
        const float y = static_cast<float>(row) - v, t = l22 * y;
        // `half` is NaN in rows that the ellipse misses; saturation converts NaN to 0.
        const float half = rough_sqrt(reach - t * t) * wider;
        const float first = saturated_fma(slope, y, first_u - half);
        const float end = fmaxf(saturated_fma(slope, y, end_u + half), first);
        // In the last row, an end of 1 is shifted out of the word. The subtraction
        // relies on the result being 0.
        const uint32_t row_begin = 1u << (8 * row);
        cells += shifted_by_eighths(row_begin, end) - shifted_by_eighths(row_begin, first);
    }
    return cells;
}

}  // namespace v3dg
