#pragma once

// Produces items on background threads before they are needed.

#include <omp.h>

#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

namespace v3dg {

// Produces items 0 to count - 1, which are consumed in that order. Thread i %
// num_threads produces item i, with a single OpenMP thread. Item i is stored in slot i
// % num_places until it has been consumed.
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

    // Waits for the next item and returns its slot. Rethrows an exception thrown while
    // the item was produced.
    size_t wait_for_next() {
        std::unique_lock<std::mutex> lock(busy_);
        changed_.wait(lock, [&] { return is_made_[used_ % num_places_] || error_; });
        if (error_) std::rethrow_exception(error_);
        return used_ % num_places_;
    }
    // Releases the slot of the next item for reuse.
    void next_is_used() {
        const std::lock_guard<std::mutex> lock(busy_);
        is_made_[used_++ % num_places_] = false;
        changed_.notify_all();
    }

  private:
    void make_all(uint64_t first, unsigned num_threads) noexcept {
        omp_set_num_threads(1);
        for (uint64_t i = first; i < count_; i += num_threads) {
            std::unique_lock<std::mutex> lock(busy_);
            changed_.wait(lock, [&] { return i < used_ + num_places_ || is_over_; });
            if (is_over_) return;
            lock.unlock();
            try {
                make_(i);
            } catch (...) {
                lock.lock();
                error_ = std::current_exception();
                is_over_ = true;
                changed_.notify_all();
                return;
            }
            lock.lock();
            is_made_[i % num_places_] = true;
            changed_.notify_all();
        }
    }
    void stop() noexcept {
        {
            const std::lock_guard<std::mutex> lock(busy_);
            is_over_ = true;
            changed_.notify_all();
        }
        for (std::thread& thread : threads_) thread.join();
        threads_.clear();
    }

    const uint64_t count_;
    const unsigned num_places_;
    const std::function<void(uint64_t)> make_;
    std::mutex busy_;
    std::condition_variable changed_;
    std::vector<bool> is_made_;
    uint64_t used_ = 0;
    bool is_over_ = false;
    std::exception_ptr error_;
    std::vector<std::thread> threads_;
};

}  // namespace v3dg
