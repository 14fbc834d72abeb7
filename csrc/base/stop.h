#pragma once

// Requests to stop long work.

#include <atomic>

namespace v3dg {

// Returns whether work is no longer wanted; with a null `stop` it always is wanted.
inline bool is_stopped(const std::atomic<bool>* stop) {
    return stop != nullptr && stop->load(std::memory_order_relaxed);
}

}  // namespace v3dg
