#pragma once

// The mutex, locks and condition variable of the standard library, with the annotations
// of base/thread_annotations.h. In WebAssembly without threads, the mutex does nothing,
// and there is no condition variable.

#if defined(__wasm__) && !defined(__wasm_atomics__)
#define V3DG_HAS_THREADS 0
#else
#define V3DG_HAS_THREADS 1
#include <chrono>
#include <condition_variable>
#endif
#include <mutex>

#include "base/thread_annotations.h"

namespace v3dg {

#if V3DG_HAS_THREADS
using StandardMutex = std::mutex;
#else
struct StandardMutex {
    void lock() {}
    bool try_lock() { return true; }
    void unlock() {}
};
#endif

class V3DG_CAPABILITY("mutex") Mutex {
  public:
    Mutex() = default;
    Mutex(const Mutex&) = delete;
    Mutex& operator=(const Mutex&) = delete;

    void lock() V3DG_ACQUIRE() { mutex_.lock(); }
    bool try_lock() V3DG_TRY_ACQUIRE(true) { return mutex_.try_lock(); }
    void unlock() V3DG_RELEASE() { mutex_.unlock(); }

  private:
    friend class Condition;
    StandardMutex mutex_;
};

// Holds a mutex until the end of the scope.
class V3DG_SCOPED_CAPABILITY MutexLock {
  public:
    explicit MutexLock(Mutex& mutex) V3DG_ACQUIRE(mutex) : mutex_(mutex) { mutex.lock(); }
    // Takes over a mutex that the caller has locked, and unlocks it at the end of the
    // scope.
    MutexLock(Mutex& mutex, std::adopt_lock_t) V3DG_REQUIRES(mutex) : mutex_(mutex) {}
    ~MutexLock() V3DG_RELEASE() { mutex_.unlock(); }
    MutexLock(const MutexLock&) = delete;
    MutexLock& operator=(const MutexLock&) = delete;

  private:
    Mutex& mutex_;
};

// Unlocks a mutex that the caller has locked, and locks it again at the end of the
// scope, even after an exception.
class V3DG_SCOPED_CAPABILITY MutexUnlock {
  public:
    explicit MutexUnlock(Mutex& mutex) V3DG_RELEASE(mutex) : mutex_(mutex) { mutex.unlock(); }
    ~MutexUnlock() V3DG_RELEASE() { mutex_.lock(); }
    MutexUnlock(const MutexUnlock&) = delete;
    MutexUnlock& operator=(const MutexUnlock&) = delete;

  private:
    Mutex& mutex_;
};

#if V3DG_HAS_THREADS
// A condition variable. Waits may end without a notification. There is no wait with a
// predicate: callers test their condition in a loop, so that clang also checks how the
// condition accesses guarded fields.
class Condition {
  public:
    using Time = std::chrono::steady_clock::time_point;

    void notify_one() { condition_.notify_one(); }
    void notify_all() { condition_.notify_all(); }
    void wait(Mutex& mutex) V3DG_REQUIRES(mutex) {
        std::unique_lock<std::mutex> lock(mutex.mutex_, std::adopt_lock);
        condition_.wait(lock);
        lock.release();
    }
    // Returns false if the time has expired.
    bool wait_until(Mutex& mutex, Time end) V3DG_REQUIRES(mutex) {
        std::unique_lock<std::mutex> lock(mutex.mutex_, std::adopt_lock);
        const std::cv_status status = condition_.wait_until(lock, end);
        lock.release();
        return status == std::cv_status::no_timeout;
    }

  private:
    std::condition_variable condition_;
};
#endif

}  // namespace v3dg
