#pragma once

#include "tile_bin/tile_bin.h"

namespace v3dg {

// The pixels of a window, row major; colour has three channels.
template <class T>
struct Picture {
    Window window;
    T background[3];
    T* color;  // premultiplied, the background composed last
    T* alpha;
    T* depth;            // expected depth, sum of weight * depth over alpha, 0 where alpha is 0; may be null
    T* count = nullptr;  // gaussians that were blended, in place of depth; may be null
};

// Gradients of the picture, laid out as it is; `depth` may be null.
template <class T>
struct PictureGradient {
    const T* color;
    const T* alpha;
    const T* depth;
};

// Blends one tile's sorted entries, front to back, and writes its pixels that are in the picture's window.
V3DG_DECLARE_PER_ISA(template <class T> void rasterize_tile(const Record<T>* records, const uint64_t* entry,
                                                            size_t count, int left, int top,
                                                            const Picture<T>& picture))

// Gradients of a tile's sorted entries, one after the other into `d_entry`, which starts as zeros.
// `d_background` (3) is added to.
V3DG_DECLARE_PER_ISA(template <class T>
                     void rasterize_tile_backward(const Record<T>* records, const uint64_t* entry,
                                                  size_t count, int left, int top, const Picture<T>& picture,
                                                  const PictureGradient<T>& d_picture,
                                                  RecordGradient<T>* d_entry, T* d_background))

}  // namespace v3dg
