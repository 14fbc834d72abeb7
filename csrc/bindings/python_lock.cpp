#include "bindings/python_lock.h"

#include <pthread.h>
#include <unistd.h>

#include <mutex>
#include <new>

namespace v3dg {

namespace {

namespace py = pybind11;

// Of threads that make themselves known to Python, one at a time. What they need for that is gone
// at some moment of the interpreter's end, so none begins once that is near.
struct Entrance {
    std::mutex busy;
    bool is_closed = false;
};

Entrance& entrance() {
    static Entrance& entrance = *new Entrance;  // threads use it to the end of the process
    return entrance;
}

void close_entrance() {
    const Unlocked unlocked;  // whoever is in it waits for Python's lock
    const std::lock_guard<std::mutex> lock(entrance().busy);
    entrance().is_closed = true;
}

// A child of fork() has none of the threads that may be in the entrance.
void renew_entrance() { new (&entrance().busy) std::mutex; }

}  // namespace

void sleep_for_ever() noexcept {
    for (;;) pause();
}

bool call_with_lock(const std::function<void()>& body) {
    PyGILState_STATE state{};
    const bool is_open = staying_if_ended([&] {
        const std::lock_guard<std::mutex> lock(entrance().busy);
        if (!entrance().is_closed) state = PyGILState_Ensure();
        return !entrance().is_closed;
    });
    if (!is_open) return false;
    // A destructor would give the lock back that a thread which is ended does not have.
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
    if (pthread_atfork(nullptr, nullptr, &renew_entrance) != 0) throw std::bad_alloc();
    py::module_::import("atexit").attr("register")(py::cpp_function(&close_entrance));
}

}  // namespace v3dg
