#pragma once

// Python's lock: released for work and acquired again, and acquired by threads that
// Python did not start.
//
// Up to Python 3.13, a thread that requests the lock while the interpreter ends is
// ended by pthread_exit(), which unwinds its stack. That aborts the process at the
// first frame that must not throw, such as a destructor, and runs other destructors
// without the lock that they need. Therefore such a thread never returns to this code:
// it sleeps until the process ends, which does not wait for it. Python 3.14 and later
// do the same.

#include <cxxabi.h>
#include <pybind11/pybind11.h>

#include <functional>

namespace v3dg {

// Sleeps until the process ends.
[[noreturn]] void sleep_for_ever() noexcept;

// Calls body(), in which Python may end the thread. No object between here and Python
// may have a destructor that needs the lock.
template <class Body>
auto staying_if_ended(const Body& body) {
    try {
        return body();
    } catch (abi::__forced_unwind&) {
        sleep_for_ever();
    }
}

// Releases Python's lock while it exists.
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

// Calls body() with Python's lock on a thread that Python did not start. Returns false,
// without a call, if the interpreter is about to end or has ended.
bool call_with_lock(const std::function<void()>& body);

// Makes call_with_lock() refuse calls before the interpreter ends. Called once, when
// the module is loaded.
void watch_end_of_python();

}  // namespace v3dg
