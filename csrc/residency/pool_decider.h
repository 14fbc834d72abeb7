#pragma once

// The deciding side of a page pool: which pages are read, come and go.
//
// Its fields belong to whoever decides, one thread at a time: the pool's deciding thread, or, in a
// pool without threads, the thread that draws, which then calls decide_next_round(). Frames call
// decide_next_round() and forget_failures(). Nothing here waits for a file. Only
// decide_next_round() waits for another thread.

#include <cstddef>
#include <vector>

#include "residency/page_policy.h"
#include "residency/pool_shared.h"

namespace v3dg {

class PoolDecider {
  public:
    explicit PoolDecider(PagePolicy& policy) : policy_(policy) {}

    // Allocates what decide() needs for so many blocks, so that it never runs out of memory.
    void reserve(size_t num_blocks, size_t num_changes);

    // The deciding thread; returns once the pool is over.
    void decide_always(PoolShared& shared) V3DG_EXCLUDES(shared.busy);
    // Returns once the pool has decided about all that it has now; waits for the deciding thread,
    // or decides in this one where there is none.
    void decide_next_round(PoolShared& shared) V3DG_REQUIRES(shared.busy);
    // Allows pages that could not be read to be tried again. Must not be called while a round is
    // under way.
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
