#pragma once

// The device on which an operation runs. bindings/backend.h selects the backend for it.

#include "base/stream.h"

#ifndef V3DG_WITH_CUDA
#define V3DG_WITH_CUDA 0
#endif

namespace v3dg {

// The host (number < 0), or a CUDA device by its index.
struct Device {
    int number = -1;

    bool is_host() const { return number < 0; }
    bool operator==(const Device& other) const { return number == other.number; }
    bool operator!=(const Device& other) const { return number != other.number; }
};

}  // namespace v3dg
