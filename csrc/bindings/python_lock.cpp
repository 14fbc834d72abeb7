#include "bindings/python_lock.h"

#include <pthread.h>
#include <unistd.h>

#include <mutex>
#include <new>

namespace v3dg {

namespace {

namespace py = pybind11;

// Serialises threads that register with Python. Registration uses state that the
// interpreter destroys at some point of its end, so no thread may start it once the end
// is near.
struct Entrance {
    std::mutex busy;
    bool is_closed = false;
};

Entrance& entrance() {
    // Never destroyed, because threads use it until the process ends.
    static Entrance& entrance = *new Entrance;
    return entrance;
}

void close_entrance() {
    const Unlocked unlocked;  // a thread in the entrance waits for Python's lock
    const std::lock_guard<std::mutex> lock(entrance().busy);
    entrance().is_closed = true;
}

// A child of fork() has none of the threads that may hold the mutex.
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
    // This is not a destructor, because a thread that Python has ended would release a
    // lock that it does not hold.
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
