#pragma once

// The frames of a page pool: the pages that a frame gets, and the page requests that it
// returns.
//
// The callers of PagePool ensure that only one thread at a time, the drawing thread,
// uses this class. So its fields need no mutex. Functions with `waits`, and frames that
// are not bounded, wait for the mutex and for the next round of the decider. Other
// functions never wait.

#include <cstddef>
#include <cstdint>
#include <vector>

#include "residency/page_arrivals.h"
#include "residency/page_policy.h"
#include "residency/pool_decider.h"
#include "residency/pool_shared.h"

namespace v3dg {

class PoolFrames {
  public:
    PoolFrames(const PagePolicy& policy, PoolDecider& decider, size_t num_bundles);

    // Reads the coarsest pages, which arrive in the first frame. Returns their total
    // size in bytes, including padding. Throws PageError.
    size_t read_roots(BlockMemory& memory);
    // Allocates memory for the changes and the blocks of a frame, and for the page
    // requests of several frames, so that exchanges need not allocate.
    void reserve(size_t num_blocks, size_t num_changes, size_t num_frames, size_t most_needs,
                 BlockMemory& memory);

    // The functions below are documented in page_pool.h.
    const std::vector<PageChange>& begin_frame(PoolShared& shared, bool is_bounded, Arrive arrive)
        V3DG_EXCLUDES(shared.busy);
    std::vector<unsigned char*> take_blocks();
    void give_back(PoolShared& shared, const std::vector<unsigned char*>& blocks)
        V3DG_EXCLUDES(shared.busy);
    FrameNeeds* lend_needs();
    NotedView note_needs(PoolShared& shared, FrameNeeds* needs, bool waits)
        V3DG_EXCLUDES(shared.busy);
    void give_up(FrameNeeds* needs) { idle_needs_.push_back(needs); }
    void begin_settling(PoolShared& shared) V3DG_EXCLUDES(shared.busy);

    float least_tolerance_px2() const { return least_of_frame_; }
    size_t num_bundles() const { return shift_.size(); }
    const std::vector<int64_t>& shift(size_t bundle) const { return shift_[bundle]; }
    const PageArrivals& arrivals() const { return arrivals_; }

  private:
    void exchange(PoolShared& shared) V3DG_REQUIRES(shared.busy);
    void forget_noted(PoolShared& shared) V3DG_REQUIRES(shared.busy);
    void take_changes(PoolShared& shared, bool is_bounded) V3DG_EXCLUDES(shared.busy);
    void swap_changes(PoolShared& shared, bool is_bounded) V3DG_REQUIRES(shared.busy);
    void apply_changes(PoolShared& shared) V3DG_EXCLUDES(shared.busy);
    size_t count_absent(const FrameNeeds& needs) const;

    const PagePolicy& policy_;
    PoolDecider& decider_;

    bool has_begun_ = false;
    bool has_looked_ = false;  // whether the last frame was not bounded
    float least_of_frame_ = 0;
    std::vector<PageChange> changes_;          // changes of the current frame
    std::vector<unsigned char*> taken_;        // blocks of these changes
    std::vector<unsigned char*> returned_;     // blocks that readers can use again
    std::vector<std::vector<int64_t>> shift_;  // [P] per bundle
    PageArrivals arrivals_;

    std::vector<FrameNeeds> all_needs_;
    std::vector<FrameNeeds*> idle_needs_;
    FrameNeeds* to_note_ = nullptr;  // page requests to pass on in the next exchange
    uint64_t num_views_ = 0;         // number of views that were noted
};

}  // namespace v3dg
