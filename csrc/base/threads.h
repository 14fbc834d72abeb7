#pragma once

// The number of threads of parallel loops.

namespace v3dg {

// Returns the number of threads of a parallel region, at least 1: the number of OpenMP,
// limited to a plausible number of processors. Returns 1 if the stack size of threads
// is too small or too large, because OpenMP would end the process.
int most_threads();

}  // namespace v3dg
