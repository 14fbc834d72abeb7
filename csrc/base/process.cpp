#include "base/process.h"

#if defined(_WIN32)
#include <windows.h>
#else
#include <pthread.h>
#include <unistd.h>

#include <new>
#endif

namespace v3dg {

#if defined(_WIN32)

int64_t process_id() { return static_cast<int64_t>(GetCurrentProcessId()); }

void at_fork(void (* /*before*/)(), void (* /*in_child*/)()) {}

void sleep_for_ever() noexcept {
    for (;;) Sleep(INFINITE);
}

#else

int64_t process_id() { return static_cast<int64_t>(getpid()); }

void at_fork(void (*before)(), void (*in_child)()) {
    if (pthread_atfork(before, nullptr, in_child) != 0) throw std::bad_alloc();
}

void sleep_for_ever() noexcept {
    for (;;) pause();
}

#endif

}  // namespace v3dg
