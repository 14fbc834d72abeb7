#pragma once

// The reading side of a page pool: takes the most urgent pages and reads them into
// blocks.
//
// Several threads read at the same time: the reading threads of the pool and the
// callers of read_some(). They wait for files, but never while they hold the mutex.
// Their shared state is in PoolShared. From the policy they use only the sources, which
// never change, and the states of pages, which are atomic.

#include <cstddef>

#include "base/span.h"
#include "residency/page_policy.h"
#include "residency/page_source.h"
#include "residency/pool_shared.h"

namespace v3dg {

class PoolReaders {
  public:
    explicit PoolReaders(const PagePolicy& policy) : policy_(policy) {}

    // A reading thread; returns once the pool has ended.
    void read_always(PoolShared& shared) const V3DG_EXCLUDES(shared.busy);
    // Reads at most this many of the most urgent pages; releases the mutex meanwhile.
    // Returns whether there was a page to read, and a block for it.
    bool read_some(PoolShared& shared, size_t most) const V3DG_REQUIRES(shared.busy);

  private:
    // A page to read, and its destination.
    struct Reading {
        PageRequest page;
        unsigned char* block;
    };

    void read_batch(PoolShared& shared, Span<Reading> batch) const V3DG_EXCLUDES(shared.busy);
    void read_together(PoolShared& shared, uint32_t bundle, Span<PageReading> pages) const
        V3DG_EXCLUDES(shared.busy);
    void finish(PoolShared& shared, uint32_t bundle, const PageReading& reading) const
        V3DG_REQUIRES(shared.busy);

    const PagePolicy& policy_;
};

}  // namespace v3dg
