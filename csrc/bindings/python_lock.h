#pragma once

// Releases and acquires the GIL (Python's global interpreter lock), also for threads
// that Python did not start.
//
// Up to Python 3.13, a thread that requests the GIL while the interpreter ends is ended
// by pthread_exit(), which unwinds its stack. Unwinding aborts the process at the first
// function that must not throw, such as a destructor, and runs other destructors
// without the GIL. Therefore such a thread must never return to this code. Instead, it
// sleeps until the process ends, which does not wait for it. Python 3.14 and later do
// the same.

#include <pybind11/pybind11.h>

#include <functional>

#ifdef __GLIBCXX__
#include <cxxabi.h>

#include "base/process.h"
#endif

namespace v3dg {

// Calls body(), during which Python may end the thread. Objects on the stack between
// this call and Python must not have destructors that need the GIL. Only GNU's C++
// library unwinds the stack of a thread that ends.
template <class Body>
auto staying_if_ended(const Body& body) {
#ifdef __GLIBCXX__
    try {
        return body();
    } catch (abi::__forced_unwind&) {
        sleep_for_ever();
    }
#else
    return body();
#endif
}

// Releases the GIL during its lifetime.
class Unlocked {
  public:
    Unlocked() : thread_(PyEval_SaveThread()) {}
    ~Unlocked() {
        staying_if_ended([this] { PyEval_RestoreThread(thread_); });
    }
    Unlocked(const Unlocked&) = delete;
    Unlocked& operator=(const Unlocked&) = delete;

  private:
    PyThreadState* thread_;
};

// Calls body() with the GIL, on a thread that Python did not start. If the interpreter
// is ending or has ended, does not call it, and returns false.
bool call_with_lock(const std::function<void()>& body);

// Makes call_with_lock() reject calls when the interpreter ends. Call this once, when
// the module is loaded.
void watch_end_of_python();

}  // namespace v3dg
