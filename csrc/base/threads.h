#pragma once

// The threads of parallel loops. They are OpenMP's or, if the compiler has no OpenMP,
// those of a pool of this process.

#include <cstddef>

namespace v3dg {

// Returns the number of threads of a parallel loop, at least 1. With OpenMP, it is
// OpenMP's number, limited to a plausible number of processors. It is 1 if the stack
// size of threads is too small or too large, because OpenMP would then end the process.
// Without OpenMP, it is OMP_NUM_THREADS or the number of processors.
int most_threads();

// Returns the index of the calling thread in its innermost parallel loop. A nested loop
// has one thread, with the index 0. Returns 0 outside parallel loops.
int thread_index();

// Returns whether the calling thread runs the body of a parallel loop.
bool is_in_parallel();

// Makes loops that the calling thread starts run on this thread only.
void use_one_thread();

#ifndef _OPENMP
// Runs work(context) on the calling thread and on up to num_threads - 1 other threads,
// and returns when all of them have finished. The work must not throw. Fewer threads
// may be used, at least one.
void run_on_threads(int num_threads, void (*work)(void* context), void* context);
#endif

}  // namespace v3dg
