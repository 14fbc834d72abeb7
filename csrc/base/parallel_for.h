#pragma once

// Parallel loops on the CPU.

#include <omp.h>

#include <cstddef>

#include "base/first_error.h"
#include "base/threads.h"

namespace v3dg {

// Calls body(i) for every i < count on all threads. Each thread claims `chunk`
// consecutive indices at a time. Results must not depend on which thread calls body.
// Exceptions of body, mostly out of memory, are rethrown.
template <class Body>
void parallel_for(size_t count, size_t chunk, const Body& body) {
    FirstError error;
    const auto run = [&](size_t first) {
        const size_t last = first + chunk < count ? first + chunk : count;
        error.run(first, [&] {
            for (size_t i = first; i < last; ++i) body(i);
        });
    };
    if (most_threads() == 1) {
        // Run without an OpenMP region: OpenMP ends the process if it has no memory for
        // threads.
        for (size_t first = 0; first < count; first += chunk) run(first);
    } else {
#pragma omp parallel for schedule(dynamic, 1) if (count > chunk) num_threads(most_threads())
        for (size_t first = 0; first < count; first += chunk) run(first);
    }
    error.rethrow();
}

}  // namespace v3dg
