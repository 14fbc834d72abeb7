#pragma once

// The readers of a page pool, which read the most urgent pages into blocks.
//
// Several threads read concurrently: the reading threads of the pool, and callers of
// read_some(). They wait for files, but never with the mutex locked. Their shared state
// is in PoolShared. From the policy, they only use the sources, which are immutable,
// and the states of pages, which are atomic.

#include <cstddef>

#include "base/span.h"
#include "residency/page_policy.h"
#include "residency/page_source.h"
#include "residency/pool_shared.h"

namespace v3dg {

class PoolReaders {
  public:
    explicit PoolReaders(const PagePolicy& policy) : policy_(policy) {}

    // The main function of a reading thread. Returns when the pool ends.
    void read_always(PoolShared& shared) const V3DG_EXCLUDES(shared.busy);
    // Reads at most `most` of the most urgent pages. The mutex is unlocked while it
    // reads. Returns whether there was a page to read and a free block for it.
    bool read_some(PoolShared& shared, size_t most) const V3DG_REQUIRES(shared.busy);

  private:
    // A page to read, and the block to read it into.
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
