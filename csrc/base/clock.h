#pragma once

// The clock that measures durations.

#include <chrono>

namespace v3dg {

// Returns seconds since an arbitrary moment; they never decrease.
inline double now() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch())
        .count();
}

}  // namespace v3dg
