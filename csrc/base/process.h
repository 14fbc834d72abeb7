#pragma once

// The number of the process, and functions that run when it forks.

#include <cstdint>

namespace v3dg {

// Returns the number of this process. A child of fork() has another number.
int64_t process_id();

// Registers functions for fork(): `before` is called in the parent before it, and
// `in_child` in the child after it. Either may be null. Does nothing on systems without
// fork(). Throws std::bad_alloc.
void at_fork(void (*before)(), void (*in_child)());

// Sleeps until the process ends.
[[noreturn]] void sleep_for_ever() noexcept;

}  // namespace v3dg
