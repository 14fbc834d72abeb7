#pragma once

// Blocks of host memory, aligned to a cache line.

#include <cstddef>
#include <cstdlib>

#if defined(_WIN32)
#include <malloc.h>
#elif defined(__linux__)
#include <sys/mman.h>
#endif

namespace v3dg {

// Returns memory that is aligned to a cache line, or null if there is none.
// free_pages() releases it. If the system supports it, large blocks use huge pages,
// because scattered reads would otherwise wait for page table look-ups.
inline void* allocate_pages(size_t bytes) {
    constexpr size_t kHugePage = size_t(2) << 20;
    const size_t alignment = bytes < 2 * kHugePage ? 64 : kHugePage;
    bytes = (bytes + alignment - 1) / alignment * alignment;
#if defined(_WIN32)
    return _aligned_malloc(bytes, alignment);
#else
    void* memory = std::aligned_alloc(alignment, bytes);
#ifdef MADV_HUGEPAGE
    if (memory != nullptr && alignment == kHugePage) madvise(memory, bytes, MADV_HUGEPAGE);
#endif
    return memory;
#endif
}

inline void free_pages(void* memory) {
#if defined(_WIN32)
    _aligned_free(memory);
#else
    std::free(memory);
#endif
}

}  // namespace v3dg
