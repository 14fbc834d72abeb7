#pragma once

// Exceptions of parallel loops.

#include <cstddef>
#include <exception>
#include <mutex>

namespace v3dg {

// Carries an exception out of a parallel loop: if several were thrown, the one with the
// lowest index.
class FirstError {
  public:
    template <class Body>
    void run(size_t index, const Body& body) noexcept {
        try {
            body();
        } catch (...) {
            const std::lock_guard<std::mutex> lock(mutex_);
            if (!error_ || index < index_) {
                error_ = std::current_exception();
                index_ = index;
            }
        }
    }
    void rethrow() const {
        if (error_) std::rethrow_exception(error_);
    }

  private:
    std::mutex mutex_;
    std::exception_ptr error_;
    size_t index_ = 0;
};

}  // namespace v3dg
