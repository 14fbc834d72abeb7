#pragma once

// Python's lock, given up for work and taken again, and taken by threads that Python did not start.
//
// Up to Python 3.13, a thread that asks for the lock while the interpreter ends is ended by
// pthread_exit(), which unwinds its stack. That aborts the process at the first frame that may not
// throw, such as a destructor, and runs other destructors without the lock that they need. So no
// such thread comes back here: it sleeps until the process ends, which waits for no such thread.
// From 3.14 on Python does the same.

#include <cxxabi.h>
#include <pybind11/pybind11.h>

#include <functional>

namespace v3dg {

// Sleeps until the process ends.
[[noreturn]] void sleep_for_ever() noexcept;

// Calls body(), in which Python may end the thread. Between here and Python nothing may have a
// destructor that needs the lock.
template <class Body>
auto staying_if_ended(const Body& body) {
    try {
        return body();
    } catch (abi::__forced_unwind&) {
        sleep_for_ever();
    }
}

// While it lives, its thread works without Python's lock.
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

// Has a thread that Python did not start call body() with Python's lock. Returns false, without a
// call, where the interpreter is about to end or has ended.
bool call_with_lock(const std::function<void()>& body);

// Sees to it that call_with_lock() refuses before the interpreter ends. Called once, when the
// module is loaded.
void watch_end_of_python();

}  // namespace v3dg
