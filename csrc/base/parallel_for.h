#pragma once

// Parallel loops on the CPU.

#ifdef _OPENMP
#include <omp.h>
#else
#include <atomic>
#endif

#include <cstddef>

#include "base/first_error.h"
#include "base/threads.h"

namespace v3dg {

// Calls body(i) for every i < count on at most `num_threads` threads; thread_index() is
// less than that number. Each thread claims `chunk` consecutive indices at a time.
// Results must not depend on which thread calls body. Exceptions of body are rethrown.
template <class Body>
void parallel_for_on(int num_threads, size_t count, size_t chunk, const Body& body) {
    FirstError error;
    const auto run = [&](size_t first) {
        const size_t last = first + chunk < count ? first + chunk : count;
        error.run(first, [&] {
            for (size_t i = first; i < last; ++i) body(i);
        });
    };
    if (most_threads() == 1) {
        // Do not use OpenMP here, because it ends the process if it has no memory for
        // threads.
        for (size_t first = 0; first < count; first += chunk) run(first);
    } else {
#ifdef _OPENMP
#pragma omp parallel for schedule(dynamic, 1) if (count > chunk) num_threads(num_threads)
        for (size_t first = 0; first < count; first += chunk) run(first);
#else
        std::atomic<size_t> next{0};
        auto claim = [&] {
            for (size_t first; (first = next.fetch_add(chunk)) < count;) run(first);
        };
        using Claim = decltype(claim);
        run_on_threads(
            count > chunk ? num_threads : 1,
            [](void* context) { (*static_cast<Claim*>(context))(); }, &claim);
#endif
    }
    error.rethrow();
}

// Calls body(i) for every i < count on all threads, like parallel_for_on().
template <class Body>
void parallel_for(size_t count, size_t chunk, const Body& body) {
    parallel_for_on(most_threads(), count, chunk, body);
}

}  // namespace v3dg
