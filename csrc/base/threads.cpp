#include "base/threads.h"

#include <omp.h>

#include <algorithm>
#include <cctype>
#include <cstdlib>

namespace v3dg {

namespace {

constexpr int kMostThreads = 1024;
// What a thread may have as its stack: with 64 KiB the median split overflows it, and more than the
// most is address space that a machine with many processors does not have.
constexpr double kLeastStackBytes = double(256 << 10);
constexpr double kMostStackBytes = double(1 << 30);

// Bytes in a text such as "512", "64 k" or "2M" of OpenMP, without a letter KiB; 0 where it is none
// of those, which OpenMP ignores.
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

}  // namespace v3dg
