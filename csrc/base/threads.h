#pragma once

// The number of threads of parallel loops.

namespace v3dg {

// Returns the number of threads that a parallel region requests from OpenMP, at least
// 1. It is OpenMP's own number, limited to a plausible number of processors, and 1 if
// the threads' stacks would be too small or too large, because OpenMP would then end
// the process.
int most_threads();

}  // namespace v3dg
