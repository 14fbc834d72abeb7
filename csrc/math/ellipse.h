#pragma once

// The ellipse of a gaussian on the image, and its extent in rows of pixels. The falloff
// at a pixel is in rasterize/rasterize_math.h.

#include "math/gaussian.h"

namespace v3dg {

// A gaussian on the image. At offset d from the centre, alpha is 2^(log2_opacity - |L
// d|²) with L = [[l11, l12], [0, l22]].
template <class V>
struct Ellipse {
    V u, v;  // centre, px
    V l11, l12, l22;
    V log2_opacity;
    V depth;
};

// A box of pixels, given by its first and last column and row. It is empty if the first
// column or row is after the last.
template <class I>
struct PixelBox {
    I x0, x1, y0, y1;

    V3DG_HD V3DG_INLINE auto holds_pixels() const { return (x0 <= x1) & (y0 <= y1); }
};

// The ellipse |L d|² = reach, in a form from which its extent in a row of pixels can be
// computed.
template <class V>
struct EllipseRows {
    V reach;
    V inverse;  // 1 / l11
    V slope;    // slope dx / dy of the line through the middles of the rows' extents
    V l22;
    // The y of the rightmost point of the ellipse, relative to its centre. The leftmost
    // point is opposite, at minus this y.
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

// Computes the extent x0 to x1 of the ellipse between the rows y0 <= y1, relative to
// its centre. A margin makes the extent slightly too large, so that only the blend step
// decides about a pixel. The result is undefined if the bounding box of the ellipse
// does not overlap the rows.
//
// Four callers use this extent to find the cells of a grid that a gaussian may reach.
// They round differently, and each explains why.
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
