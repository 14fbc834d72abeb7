#pragma once

// Computes items ahead of time, on background threads.

#include <cstddef>
#include <cstdint>
#include <exception>
#include <functional>
#include <thread>
#include <utility>
#include <vector>

#include "base/mutex.h"
#include "base/threads.h"

namespace v3dg {

// Computes items 0 to count - 1, which are used in this order. Thread i % num_threads
// computes item i, without starting threads for parallel loops. Item i occupies slot i
// % num_places until it has been used.
class Ahead {
  public:
    Ahead(uint64_t count, unsigned num_threads, unsigned num_places,
          std::function<void(uint64_t)> make)
        : count_(count),
          num_places_(num_places),
          make_(std::move(make)),
          is_made_(num_places, false) {
        try {
            for (unsigned t = 0; t < num_threads; ++t)
                threads_.emplace_back([this, t, num_threads] { make_all(t, num_threads); });
        } catch (...) {
            stop();
            throw;
        }
    }
    ~Ahead() { stop(); }
    Ahead(const Ahead&) = delete;
    Ahead& operator=(const Ahead&) = delete;

    // Waits for the next item, and returns its slot. If computing it threw an
    // exception, rethrows it.
    size_t wait_for_next() {
        const MutexLock lock(busy_);
        while (!is_made_[used_ % num_places_] && !error_) changed_.wait(busy_);
        if (error_) std::rethrow_exception(error_);
        return used_ % num_places_;
    }
    // Frees the slot of the next item.
    void next_is_used() {
        const MutexLock lock(busy_);
        is_made_[used_++ % num_places_] = false;
        changed_.notify_all();
    }

  private:
    void make_all(uint64_t first, unsigned num_threads) noexcept {
        use_one_thread();
        for (uint64_t i = first; i < count_; i += num_threads) {
            if (!wait_for_slot(i)) return;
            try {
                make_(i);
            } catch (...) {
                fail(std::current_exception());
                return;
            }
            const MutexLock lock(busy_);
            is_made_[i % num_places_] = true;
            changed_.notify_all();
        }
    }
    // Waits until the slot of an item is free. Returns false if no more items are
    // needed.
    bool wait_for_slot(uint64_t item) {
        const MutexLock lock(busy_);
        while (item >= used_ + num_places_ && !is_over_) changed_.wait(busy_);
        return !is_over_;
    }
    // The mutex is not locked in the catch block, because Clang's thread-safety
    // analysis skips catch blocks.
    void fail(const std::exception_ptr& error) noexcept {
        const MutexLock lock(busy_);
        error_ = error;
        is_over_ = true;
        changed_.notify_all();
    }
    void stop() noexcept {
        {
            const MutexLock lock(busy_);
            is_over_ = true;
            changed_.notify_all();
        }
        for (std::thread& thread : threads_) thread.join();
        threads_.clear();
    }

    const uint64_t count_;
    const unsigned num_places_;
    const std::function<void(uint64_t)> make_;
    Mutex busy_;
    Condition changed_;
    std::vector<bool> is_made_ V3DG_GUARDED_BY(busy_);
    uint64_t used_ V3DG_GUARDED_BY(busy_) = 0;
    bool is_over_ V3DG_GUARDED_BY(busy_) = false;
    std::exception_ptr error_ V3DG_GUARDED_BY(busy_);
    std::vector<std::thread> threads_;
};

}  // namespace v3dg
