// The threads of parallel loops with OpenMP. Without OpenMP, thread_pool.cpp is used.

#ifdef _OPENMP

#include "base/threads.h"

#include <omp.h>

#include <algorithm>
#include <cctype>
#include <cstdlib>

namespace v3dg {

namespace {

constexpr int kMostThreads = 1024;
// Limits for the stack size of a thread. The median split overflows a stack of 64 KiB.
// On machines with many processors, the address space does not suffice for larger
// stacks than the upper limit.
constexpr double kLeastStackBytes = double(256 << 10);
constexpr double kMostStackBytes = double(1 << 30);

// Returns the bytes of a stack size in OpenMP's notation, such as "512", "64 k" or
// "2M". A number without a unit is in KiB. Returns 0 for invalid texts, which OpenMP
// ignores.
double stack_bytes_of(const char* text) {
    char* end = nullptr;
    const double value = std::strtod(text, &end);
    if (end == text) return 0;
    while (std::isspace(static_cast<unsigned char>(*end)) != 0) ++end;
    switch (std::tolower(static_cast<unsigned char>(*end))) {
        case 'b': return value;
        case '\0':
        case 'k': return value * (1 << 10);
        case 'm': return value * (1 << 20);
        case 'g': return value * (1 << 30);
        default: return 0;
    }
}

bool has_fitting_stacks() {
    for (const char* name : {"OMP_STACKSIZE", "GOMP_STACKSIZE"}) {
        const char* const text = std::getenv(name);
        const double bytes = text == nullptr ? 0 : stack_bytes_of(text);
        if (bytes > 0) return bytes >= kLeastStackBytes && bytes <= kMostStackBytes;
    }
    return true;
}

}  // namespace

int most_threads() {
    static const int most = has_fitting_stacks() ? kMostThreads : 1;
    return std::min(omp_get_max_threads(), most);
}

int thread_index() { return omp_get_thread_num(); }

bool is_in_parallel() { return omp_in_parallel() != 0; }

void use_one_thread() { omp_set_num_threads(1); }

}  // namespace v3dg

#endif  // _OPENMP
