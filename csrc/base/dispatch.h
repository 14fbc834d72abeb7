#pragma once

// The device that an operation runs on, and the one place that chooses between the two halves of an
// operation.

#include "base/stream.h"

#ifndef V3DG_WITH_CUDA
#define V3DG_WITH_CUDA 0
#endif

namespace v3dg {

// The host, or a CUDA device by its number.
struct Device {
    int number = -1;

    bool is_host() const { return number < 0; }
    bool operator==(const Device& other) const { return number == other.number; }
    bool operator!=(const Device& other) const { return number != other.number; }
};

}  // namespace v3dg

// Runs an operation on the device of `work`: cpu::operation(...), or cuda::operation(...,
// work.stream()).
#define V3DG_DISPATCH(work, operation, ...)                                                       \
    [&] {                                                                                         \
        if constexpr (V3DG_WITH_CUDA != 0)                                                        \
            if (!(work).device().is_host()) return cuda::operation(__VA_ARGS__, (work).stream()); \
        return cpu::operation(__VA_ARGS__);                                                       \
    }()
