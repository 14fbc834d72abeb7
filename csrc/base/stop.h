#pragma once

// Requests to stop work that takes long.

#include <atomic>

namespace v3dg {

// Returns whether the work must stop. Returns false if `stop` is null.
inline bool is_stopped(const std::atomic<bool>* stop) {
    return stop != nullptr && stop->load(std::memory_order_relaxed);
}

}  // namespace v3dg
