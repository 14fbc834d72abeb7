#pragma once

// A record: one gaussian projected into a picture, ready to be blended.

#include <cstdint>

#include "math/ellipse.h"

namespace v3dg {

// A gaussian in a picture. Ellipse explains u, v, L and log2_opacity.
template <class T>
struct Record {
    T u, v, l11, l12, l22, log2_opacity;
    T color[3];
    T depth;
    // The first and last column and row of pixels whose centres the gaussian can reach,
    // clipped to the part of the image that is drawn (Window in frame/image.h).
    uint16_t x0, x1, y0, y1;
};

// Sets all fields except colour and pixel box.
template <class T>
V3DG_HD V3DG_INLINE void set_ellipse(const Ellipse<T>& e, Record<T>& r) {
    r.u = e.u;
    r.v = e.v;
    r.l11 = e.l11;
    r.l12 = e.l12;
    r.l22 = e.l22;
    r.log2_opacity = e.log2_opacity;
    r.depth = e.depth;
}

// Sets all fields except colour.
template <class T>
V3DG_HD V3DG_INLINE void set_ellipse(const Ellipse<T>& e, const PixelBox<int>& box, Record<T>& r) {
    set_ellipse(e, r);
    r.x0 = static_cast<uint16_t>(box.x0);
    r.x1 = static_cast<uint16_t>(box.x1);
    r.y0 = static_cast<uint16_t>(box.y0);
    r.y1 = static_cast<uint16_t>(box.y1);
}

// The sum over pixels of the absolute gradient with respect to a gaussian's centre, for
// each axis. It is large even where the signed gradients of pixels cancel.
template <class V>
struct CenterSize {
    V u, v;

    V3DG_HD V3DG_INLINE CenterSize& operator+=(const CenterSize& d) {
        u += d.u;
        v += d.v;
        return *this;
    }
};

// Gradients with respect to the centres of gaussians, 1 / px, (N, 2) each. Either array
// may be null.
template <class T>
struct CenterGradients {
    T* sum;
    CenterSize<T>* size;
};

// The gradients of the ellipse and the colour of one record.
template <class T>
struct RecordGradient {
    Ellipse<T> ellipse;
    T color[3];

    V3DG_HD RecordGradient& operator+=(const RecordGradient& d) {
        ellipse.u += d.ellipse.u;
        ellipse.v += d.ellipse.v;
        ellipse.l11 += d.ellipse.l11;
        ellipse.l12 += d.ellipse.l12;
        ellipse.l22 += d.ellipse.l22;
        ellipse.log2_opacity += d.ellipse.log2_opacity;
        ellipse.depth += d.ellipse.depth;
        for (int c = 0; c < 3; ++c) color[c] += d.color[c];
        return *this;
    }
};

}  // namespace v3dg
