#pragma once

// The ellipse that a gaussian covers on the image, and its extent in rows of pixels.
// rasterize/rasterize_math.h has its falloff over a pixel.

#include "math/gaussian.h"

namespace v3dg {

// Alpha at offset d from the centre is 2^(log2_opacity - |L d|²) with L = [[l11, l12],
// [0, l22]].
template <class V>
struct Ellipse {
    V u, v;  // px
    V l11, l12, l22;
    V log2_opacity;
    V depth;
};

// The first and the last pixel that something covers, in x and in y. A box is empty if
// a first pixel is after its last one.
template <class I>
struct PixelBox {
    I x0, x1, y0, y1;

    V3DG_HD V3DG_INLINE auto holds_pixels() const { return (x0 <= x1) & (y0 <= y1); }
};

// The ellipse |L d|² = reach, prepared for computing its extent in a row of pixels.
template <class V>
struct EllipseRows {
    V reach;
    V inverse;  // 1 / l11
    V slope;    // dx / dy of the line through the centres of the rows' extents
    V l22;
    // The height relative to the centre at which the ellipse extends farthest right. It
    // extends farthest left at the opposite height.
    V rightmost;
};

// Returns the ellipse on which alpha is 1/255.
template <class V>
V3DG_HD V3DG_INLINE EllipseRows<V> ellipse_rows(V l11, V l12, V l22, V log2_opacity) {
    EllipseRows<V> e;
    e.reach = log2_opacity - all_lanes<V>(Lane<V>(kLog2MinAlpha));
    e.inverse = 1 / l11;
    e.slope = -l12 * e.inverse;
    e.l22 = l22;
    e.rightmost = -l12 * sqrt_of(e.reach) / (l22 * sqrt_of(l12 * l12 + l22 * l22));
    return e;
}

// Sets x0 to x1, the extent that the ellipse may have between the heights y0 <= y1, all
// relative to its centre. The extent includes a margin, so that the blend step alone
// decides. The result is undefined if the ellipse's box does not meet the heights.
//
// Four callers derive the cells of a grid that a gaussian may reach from this extent.
// They round differently on purpose; each one documents why.
template <class V>
V3DG_HD V3DG_INLINE void row_extent(const EllipseRows<V>& e, V y0, V y1, V& x0, V& x1) {
    const V a = min_of(max_of(e.rightmost, y0), y1), b = min_of(max_of(-e.rightmost, y0), y1);
    const V half_a = sqrt_of(max_of(e.reach - e.l22 * e.l22 * a * a, V{})) * e.inverse;
    const V half_b = sqrt_of(max_of(e.reach - e.l22 * e.l22 * b * b, V{})) * e.inverse;
    const V margin = Lane<V>(1e-2) + Lane<V>(1e-3) * (half_a + half_b);
    x0 = e.slope * b - half_b - margin;
    x1 = e.slope * a + half_a + margin;
}

}  // namespace v3dg
