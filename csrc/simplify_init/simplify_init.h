#pragma once

#include <cstdint>

#include "base/span.h"

namespace v3dg {

// Gaussians as rows; `num_sh` is 3 times the number of SH bases.
struct RowsIn {
    const float *means, *quats, *scales, *opacities, *sh;
    int num_sh;
};
struct RowsOut {
    float *means, *quats, *scales, *opacities, *sh;
};

// Starts of coarser clusters. Segment g takes gaussians in_offset[g] .. in_offset[g + 1] to as many as
// out_offset says, at most as many as come in. Decisions are made in the order of the rows, ties by index,
// and do not depend on threads.

// Keeps the gaussians with the largest opacity * (s1 s2 s3)^(2/3), the same share of each of eight cells of a
// median split, and multiplies their scales by `growth` (V3DG, section 3.2: 2^(1/6)).
void prune(const RowsIn& in, Span<const int64_t> in_offset, Span<const int64_t> out_offset, float growth,
           const RowsOut& out);

// Joins pairs of gaussians, cheapest first, until as many are left as wanted. A pair becomes the gaussian
// with the same first and second moments, each weighted by opacity times surface area, and the same area
// times opacity as far as an opacity of 1 allows; it costs what its members differ in place and colour.
void merge(const RowsIn& in, Span<const int64_t> in_offset, Span<const int64_t> out_offset,
           const RowsOut& out);

}  // namespace v3dg
