#pragma once

// The process: its number, and what must happen when it forks.

#include <cstdint>

namespace v3dg {

// Returns the number of this process. A child of fork() has another number.
int64_t process_id();

// Calls `before` in the parent before a fork(), and `in_child` in the child after it;
// either may be null. Does nothing on systems without fork(). Throws std::bad_alloc.
void at_fork(void (*before)(), void (*in_child)());

// Sleeps until the process ends.
[[noreturn]] void sleep_for_ever() noexcept;

}  // namespace v3dg
