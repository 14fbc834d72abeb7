#pragma once

// The deciding part of a page pool: which pages are read, become resident, and are
// evicted.
//
// One thread at a time uses the fields: the deciding thread of the pool or, in a pool
// without threads, the drawing thread, which then calls decide_next_round(). Frames
// call decide_next_round() and forget_failures(). No function here waits for a file.
// Only decide_next_round() waits for another thread.

#include <cstddef>
#include <vector>

#include "residency/page_policy.h"
#include "residency/pool_shared.h"

namespace v3dg {

class PoolDecider {
  public:
    explicit PoolDecider(PagePolicy& policy) : policy_(policy) {}

    // Allocates the memory that decide() needs for this many blocks, so that it never
    // runs out of memory.
    void reserve(size_t num_blocks, size_t num_changes);

    // The deciding thread; returns once the pool has ended.
    void decide_always(PoolShared& shared) V3DG_EXCLUDES(shared.busy);
    // Returns once the pool has decided about everything that is known now. Waits for
    // the deciding thread, or decides in the calling thread if there is none.
    void decide_next_round(PoolShared& shared) V3DG_REQUIRES(shared.busy);
    // Allows another attempt at pages that could not be read. Must not be called during
    // a round.
    void forget_failures(PoolShared& shared) V3DG_REQUIRES(shared.busy);

  private:
    void decide(PoolShared& shared) V3DG_REQUIRES(shared.busy);
    void adapt_tolerance(PoolShared& shared, const FrameNeeds& needs) V3DG_REQUIRES(shared.busy);

    PagePolicy& policy_;
    std::vector<LoadedPage> loaded_;
    PagesComing coming_;
    std::vector<PageRequest> chosen_;
};

}  // namespace v3dg
