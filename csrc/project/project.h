#pragma once

#include <climits>
#include <cstddef>
#include <cstdint>

#include "base/isa.h"
#include "project/project_math.h"

namespace v3dg {

constexpr int kTileSize = 32;  // px; pictures are drawn tile by tile

// Gaussians of one model, a plane an attribute. Planes hold `kPlanePadding` elements more than there are
// gaussians, so that a vector load may run past the last.
constexpr size_t kPlanePadding = 16;
template <class T>
struct GaussianPlanes {
    const T* mean[3];
    const T* quat[4];
    const T* scale[3];
    const T* opacity;
    const T* sh[3 * kMaxShBases];  // base by base, three channels each
    int sh_degree;
};

// A run of gaussians of one model, placed in front of the camera.
template <class T>
struct Draw {
    const GaussianPlanes<T>* model;
    uint64_t first, count;
    ModelView<T> view;
    T filter_px2;
    bool compensate;  // opacity for what the filter adds
};

// The pixels [x0, x1) x [y0, y1) of a picture.
struct Window {
    int x0, y0, x1, y1;
    V3DG_INLINE int width() const { return x1 - x0; }
    V3DG_INLINE int height() const { return y1 - y0; }
    V3DG_INLINE bool contains(int x, int y) const { return x0 <= x && x < x1 && y0 <= y && y < y1; }
};

// One gaussian on the image, ready to blend. A reader finds the meaning of L in project_math.h.
template <class T>
struct Record {
    T u, v, l11, l12, l22, log2_opacity;
    T color[3];
    T depth;
    // First and last pixel whose centre the gaussian can reach, cut to the image or the window that is drawn.
    uint16_t x0, x1, y0, y1;
};

// Sets all of a record but its colour.
template <class T>
V3DG_HD V3DG_INLINE void set_ellipse(const Ellipse<T>& e, int x0, int x1, int y0, int y1, Record<T>& r) {
    r.u = e.u;
    r.v = e.v;
    r.l11 = e.l11;
    r.l12 = e.l12;
    r.l22 = e.l22;
    r.log2_opacity = e.log2_opacity;
    r.depth = e.depth;
    r.x0 = static_cast<uint16_t>(x0);
    r.x1 = static_cast<uint16_t>(x1);
    r.y0 = static_cast<uint16_t>(y0);
    r.y1 = static_cast<uint16_t>(y1);
}

// Gradients of the ellipse and colour of one record.
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

// Gradients of gaussians, each (N,) or (N, k) row major, and of the SH coefficients (N, bases, 3).
template <class T>
struct GaussianGradients {
    T *means, *quats, *scales, *opacities, *sh;
};

// What of the whole image a run of gaussians reaches, whichever window of it is drawn.
struct Reach {
    uint64_t in_frustum = 0;              // gaussians whose extent meets the image
    uint64_t drawn = 0;                   // of them, those that reach a pixel centre
    uint64_t pairs = 0;                   // of those with tiles
    int top = INT_MAX, bottom = INT_MIN;  // rows that hold all those pixels
};

// Projects gaussians [skip, skip + count) of a draw and writes a record, in order, for each one that reaches
// a pixel centre in the window: in front of the near plane, alpha of at least 1/255 somewhere, a positive
// finite determinant. The window may be empty, and is otherwise within the camera's image. `source` (or null)
// receives `source_base` plus the gaussian's place behind `skip`. Returns the number of records.
V3DG_DECLARE_PER_ISA(template <class T> size_t project(const Draw<T>& draw, uint64_t skip, uint64_t count,
                                                       const Pinhole<T>& camera, const Window& window,
                                                       Record<T>* records, uint32_t* source,
                                                       uint32_t source_base, Reach& reach))

// Writes the gradients of the `count` gaussians `source` (places in one draw) from those of their records.
V3DG_DECLARE_PER_ISA(template <class T> void project_backward(const Draw<T>& draw, const uint32_t* source,
                                                              const RecordGradient<T>* d_records,
                                                              size_t count, const Pinhole<T>& camera,
                                                              const GaussianGradients<T>& out))

}  // namespace v3dg
