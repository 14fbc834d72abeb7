#pragma once

#include <cstddef>

#include "base/isa.h"
#include "frame/entry.h"
#include "frame/image.h"
#include "frame/record.h"

namespace v3dg {

// Blends one tile's sorted entries, front to back, and writes its pixels that are in the picture's
// window.
V3DG_DECLARE_PER_ISA(template <class T>
                     void rasterize_tile(const Record<T>* records, EntryFormat format,
                                         const uint64_t* entry, size_t count, int left, int top,
                                         const Picture<T>& picture))

// Gradients of a tile's sorted entries, one after the other into `d_entry`, and where that is not
// null the sizes of those by their centres into `size`; both start as zeros. `d_background` (3) is
// added to.
V3DG_DECLARE_PER_ISA(template <class T> void rasterize_tile_backward(
    const Record<T>* records, EntryFormat format, const uint64_t* entry, size_t count, int left,
    int top, const Picture<T>& picture, const PictureGradient<T>& d_picture,
    RecordGradient<T>* d_entry, CenterSize<T>* size, T* d_background))

}  // namespace v3dg
