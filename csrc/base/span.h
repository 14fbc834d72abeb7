#pragma once

// Spans of elements, on the host or on a device.

#include <cassert>
#include <cstddef>

#include "base/host_device.h"

namespace v3dg {

// A reference to contiguous elements, which it does not own.
template <class T>
struct Span {
    T* data = nullptr;
    size_t size = 0;

    V3DG_HD T& operator[](size_t i) const {
        assert(i < size);
        return data[i];
    }
    V3DG_HD T* begin() const { return data; }
    V3DG_HD T* end() const { return data + size; }
    V3DG_HD bool empty() const { return size == 0; }
    V3DG_HD operator Span<const T>() const { return {data, size}; }
};

}  // namespace v3dg
