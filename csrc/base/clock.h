#pragma once

// The clock for measuring durations.

#include <chrono>

namespace v3dg {

// Returns seconds since an arbitrary time. The result never decreases.
inline double now() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch())
        .count();
}

}  // namespace v3dg
