#pragma once

// The contract of projection on the CPU. It is compiled once for each instruction set.

#include <climits>
#include <cstddef>
#include <cstdint>

#include "base/isa.h"
#include "frame/draw_list.h"
#include "frame/image.h"
#include "frame/record.h"
#include "project/project_math.h"

namespace v3dg {

// The extent of a run of gaussians in the whole image, regardless of the window that is
// drawn.
struct Reach {
    uint64_t in_frustum = 0;              // gaussians whose extent meets the image
    uint64_t drawn = 0;                   // gaussians that reach a pixel centre
    uint64_t entries = 0;                 // entries of those in the lists of tiles
    int top = INT_MAX, bottom = INT_MIN;  // rows that contain all those pixels
};

// Projects gaussians [skip, skip + count) of a draw. Writes a record, in order, for
// each gaussian that reaches a pixel centre in the window: it is beyond the near plane,
// its alpha is at least 1/255 somewhere, and its determinant is positive and finite.
// The window may be empty; otherwise it is inside the camera's image. `source`, unless
// null, receives `source_base` plus the gaussian's index counted from `skip`. Returns
// the number of records.
V3DG_DECLARE_PER_ISA(template <class T> size_t project(
    const Draw<T>& draw, uint64_t skip, uint64_t count, const Intrinsics<T>& camera,
    const Window& window, Record<T>* records, uint32_t* source, uint32_t source_base, Reach& reach))

// Writes the gradients of the `count` gaussians with the indices `source` in one draw,
// from the gradients of their records.
V3DG_DECLARE_PER_ISA(template <class T>
                     void project_backward(const Draw<T>& draw, const uint32_t* source,
                                           const RecordGradient<T>* d_records, size_t count,
                                           const Intrinsics<T>& camera, const GaussianRows<T>& out))

}  // namespace v3dg
