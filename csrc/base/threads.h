#pragma once

// The number of threads of parallel loops.

namespace v3dg {

// Returns the number of threads that a parallel region requests from OpenMP, at least 1. It is
// OpenMP's own number, but at most the number of processors that a machine may have, and 1 where
// the threads' stacks would be too small or too large: OpenMP would end the process.
int most_threads();

}  // namespace v3dg
