#pragma once

#include <atomic>

namespace v3dg {

// Whether work is no longer wanted; null: it always is.
inline bool is_stopped(const std::atomic<bool>* stop) {
    return stop != nullptr && stop->load(std::memory_order_relaxed);
}

}  // namespace v3dg
