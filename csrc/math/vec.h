#pragma once

// Dot and cross products.

#include "math/lanes.h"

namespace v3dg {

template <class V>
V3DG_HD V3DG_INLINE V dot3(const V a[3], const V b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}
template <class V>
V3DG_HD V3DG_INLINE void cross3(const V a[3], const V b[3], V c[3]) {
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

}  // namespace v3dg
