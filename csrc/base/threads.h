#pragma once

// The threads of parallel loops: those of OpenMP, or of a pool of this process where
// the compiler has no OpenMP.

#include <cstddef>

namespace v3dg {

// Returns the number of threads of a parallel loop, at least 1: the number of OpenMP,
// limited to a plausible number of processors. Returns 1 if the stack size of threads
// is too small or too large, because OpenMP would end the process. Without OpenMP, it
// is OMP_NUM_THREADS or the number of processors.
int most_threads();

// Returns the number of the calling thread in its innermost parallel loop: 0 up to the
// number of threads of that loop. A nested loop has one thread, whose number is 0.
// Returns 0 outside of parallel loops.
int thread_index();

// Returns whether the calling thread runs the body of a parallel loop.
bool is_in_parallel();

// Makes the loops that the calling thread starts use this thread alone.
void use_one_thread();

#ifndef _OPENMP
// Runs work(context) on the calling thread and on up to num_threads - 1 others at the
// same time, and returns when all have finished. The work must not throw. The number
// of threads may be smaller, down to one.
void run_on_threads(int num_threads, void (*work)(void* context), void* context);
#endif

}  // namespace v3dg
