#pragma once

// The decider of a page pool. It decides which pages are read, become resident, or are
// evicted.
//
// Only one thread at a time uses its fields: the deciding thread or, in a pool without
// threads, the drawing thread. The drawing thread may also call decide_next_round() and
// forget_failures(). No function waits for a file, and only decide_next_round() waits
// for another thread.

#include <cstddef>
#include <vector>

#include "residency/page_policy.h"
#include "residency/pool_shared.h"

namespace v3dg {

class PoolDecider {
  public:
    explicit PoolDecider(PagePolicy& policy) : policy_(policy) {}

    // Allocates all memory for decide(), so that decide() cannot run out of memory.
    void reserve(size_t num_blocks, size_t num_changes);

    // The main function of the deciding thread. Returns when the pool ends.
    void decide_always(PoolShared& shared) V3DG_EXCLUDES(shared.busy);
    // Returns after the pool has decided about everything that is known at the time of
    // the call. Waits for the deciding thread; if there is none, the calling thread
    // decides.
    void decide_next_round(PoolShared& shared) V3DG_REQUIRES(shared.busy);
    // Clears the record of pages that could not be read, so that they are tried again.
    // Must not be called during a round.
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
