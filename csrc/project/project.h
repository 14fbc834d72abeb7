#pragma once

// Projection on the CPU. The functions are compiled once per instruction set.

#include <climits>
#include <cstddef>
#include <cstdint>

#include "base/isa.h"
#include "frame/draw_list.h"
#include "frame/image.h"
#include "frame/record.h"
#include "project/pose_gradient.h"
#include "project/project_math.h"

namespace v3dg {

// How much a run of gaussians covers in the whole image, not only in the window that is
// drawn.
struct Reach {
    uint64_t in_frustum = 0;  // number of gaussians whose extent meets the image
    uint64_t drawn = 0;       // number of gaussians that reach a pixel centre
    uint64_t entries = 0;     // number of (gaussian, tile) pairs of gaussians that are
                              // drawn
    // Range of the pixel rows that the drawn gaussians cover.
    int top = INT_MAX, bottom = INT_MIN;
};

// Gaussians that will be projected next. They are prefetched into the cache.
template <class T>
struct NextRun {
    const GaussianPlanes<T>* model = nullptr;  // null if there are none, or if they are
                                               // coded
    uint64_t first = 0;
};

// Projects gaussians [skip, skip + count) of a draw. A gaussian is drawn if it is
// beyond the near plane, its alpha is at least 1/255 somewhere, its determinant is
// positive and finite, and it reaches a pixel centre in the window. Writes a record for
// each drawn gaussian, in order, and returns the number of records.
//
// The window must be empty or inside the camera's image. If `source` is not null,
// source[r] is set to `source_base` plus the index, relative to `skip`, of the gaussian
// of record r. `next` is only a hint and does not change the result.
V3DG_DECLARE_PER_ISA(template <class T> size_t project(const Draw<T>& draw, uint64_t skip,
                                                       uint64_t count, const Intrinsics<T>& camera,
                                                       const Window& window, Record<T>* records,
                                                       uint32_t* source, uint32_t source_base,
                                                       Reach& reach, const NextRun<T>& next = {}))

// Computes the gradients of gaussians from the gradients of their records. source[r] is
// the index in the draw of record r's gaussian.
V3DG_DECLARE_PER_ISA(template <class T>
                     void project_backward(const Draw<T>& draw, const uint32_t* source,
                                           const RecordGradient<T>* d_records, size_t count,
                                           const Intrinsics<T>& camera, const GaussianRows<T>& out))
// Like project_backward(), but adds to `out`. If `pose` is not null, it also adds the
// terms of the gradient of the camera's pose.
V3DG_DECLARE_PER_ISA(template <class T> void add_project_backward(
    const Draw<T>& draw, const uint32_t* source, const RecordGradient<T>* d_records, size_t count,
    const Intrinsics<T>& camera, const GaussianRows<T>& out, PoseSums<double>* pose))

}  // namespace v3dg
