#pragma once

// Transfers exceptions out of parallel loops.

#include <cstddef>
#include <exception>

#include "base/mutex.h"

namespace v3dg {

// Transfers an exception out of a parallel loop. If several are thrown, the one with
// the lowest index is kept.
class FirstError {
  public:
    template <class Body>
    void run(size_t index, const Body& body) noexcept {
        try {
            body();
        } catch (...) {
            keep_lowest(index, std::current_exception());
        }
    }
    // Rethrows the exception if there is one. Call this after the loop.
    void rethrow() {
        const MutexLock lock(mutex_);
        if (error_) std::rethrow_exception(error_);
    }

  private:
    // The mutex is not locked in the catch block, because Clang's thread-safety
    // analysis skips catch blocks.
    void keep_lowest(size_t index, const std::exception_ptr& error) noexcept {
        const MutexLock lock(mutex_);
        if (error_ && index >= index_) return;
        error_ = error;
        index_ = index;
    }

    Mutex mutex_;
    std::exception_ptr error_ V3DG_GUARDED_BY(mutex_);
    size_t index_ V3DG_GUARDED_BY(mutex_) = 0;
};

}  // namespace v3dg
