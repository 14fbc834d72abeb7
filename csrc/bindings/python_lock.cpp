#include "bindings/python_lock.h"

#include <mutex>
#include <new>

#include "base/process.h"

namespace v3dg {

namespace {

namespace py = pybind11;

// Serialises the registration of threads with Python, which uses state that the
// interpreter destroys when it ends. Before that, `is_closed` becomes true, and no more
// threads are registered.
struct Entrance {
    std::mutex busy;
    bool is_closed = false;
};

Entrance& entrance() {
    // The mutex is never destroyed, because threads use it until the process ends.
    static Entrance& entrance = *new Entrance;
    return entrance;
}

void close_entrance() {
    // Release the GIL, because a thread that holds the mutex may be waiting for it.
    const Unlocked unlocked;
    const std::lock_guard<std::mutex> lock(entrance().busy);
    entrance().is_closed = true;
}

// Replaces the mutex in the child of a fork(), in which the thread that locked it does
// not exist.
void renew_entrance() { new (&entrance().busy) std::mutex; }

}  // namespace

bool call_with_lock(const std::function<void()>& body) {
    PyGILState_STATE state{};
    const bool is_open = staying_if_ended([&] {
        const std::lock_guard<std::mutex> lock(entrance().busy);
        if (!entrance().is_closed) state = PyGILState_Ensure();
        return !entrance().is_closed;
    });
    if (!is_open) return false;
    // A destructor must not unlock the mutex. If Python ends the thread, the destructor
    // would unlock a mutex that the thread has not locked.
    try {
        staying_if_ended(body);
    } catch (...) {
        staying_if_ended([&] { PyGILState_Release(state); });
        throw;
    }
    staying_if_ended([&] { PyGILState_Release(state); });
    return true;
}

void watch_end_of_python() {
    at_fork(nullptr, &renew_entrance);
    py::module_::import("atexit").attr("register")(py::cpp_function(&close_entrance));
}

}  // namespace v3dg
