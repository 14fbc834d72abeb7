#pragma once

#include <cstddef>

namespace v3dg {

// Calls body(i) for every i < count on all threads; `chunk` neighbours go to one thread together.
// Bodies may not throw and may not depend on which thread runs them.
template <class Body>
void parallel_for(size_t count, size_t chunk, const Body& body) {
#pragma omp parallel for schedule(dynamic, 1) if (count > chunk)
    for (size_t first = 0; first < count; first += chunk) {
        const size_t last = first + chunk < count ? first + chunk : count;
        for (size_t i = first; i < last; ++i) body(i);
    }
}

}  // namespace v3dg
