#pragma once

// A pool of pages in memory of a fixed size, independent of the device. The pool treats
// pages as bytes that it reads; the drawing code copies them to their slots.
//
// In each frame, the drawing thread hands over the needs of its cut and receives the
// pages that arrive and leave before the frame. Threads of the pool decide which pages
// these are (page_policy.h) and read them into blocks. Frames and these threads share a
// mutex that is held only to swap buffers. A frame that finds the mutex held goes on
// without an exchange. pool_shared.h documents who owns which fields and who may wait.

#include <memory>
#include <vector>

#include "quantize/quantize.h"
#include "residency/page_arrivals.h"
#include "residency/page_blocks.h"
#include "residency/page_policy.h"
#include "residency/pool_types.h"

namespace v3dg {

// One thread at a time may call begin_frame(), take_blocks(), give_back(), release(),
// lend_needs(), note_needs(), give_up() and begin_settling(). Every function that locks
// the mutex throws std::runtime_error in a child of fork().
class PagePool {
  public:
    // Reads the coarsest pages. Throws PageError, or std::invalid_argument if there is
    // no room for the coarsest pages and one more page of each bundle.
    PagePool(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
             std::shared_ptr<BlockMemory> memory);
    ~PagePool();
    PagePool(const PagePool&) = delete;
    PagePool& operator=(const PagePool&) = delete;

    size_t num_bundles() const;
    const SlotPlan& plan() const;
    bool keeps_codes() const;
    int max_sh_degree() const;
    // Returns the [P] shifts of the host's PageTable, including the changes of the
    // frame that began last.
    Span<const int64_t> shift(size_t bundle) const;
    Span<const int32_t> begins(size_t bundle) const;
    const PageArrivals& arrivals() const;
    const PageSource& source(uint32_t bundle) const;
    // Returns the slot and content of an arriving page, for a pool that keeps codes.
    SlotPage slot_page(const PageChange& change) const;
    // Returns the total bytes of the blocks and of the coarsest pages.
    size_t most_bytes_on_their_way() const;
    // Returns the largest number of page changes in a frame.
    size_t most_changes() const;
    // Returns the largest number of needs per view that the pool has room for,
    // including pages requested ahead.
    size_t most_needs() const;

    // Begins a frame: returns the pages that arrive and leave before it, in this order.
    // The first frame brings the coarsest pages. The bytes of arriving pages stay valid
    // until release() or the next call. A bounded frame never waits. A frame that is
    // not bounded takes all pages that were read, waits until the pool has decided
    // about them, and ends all fades; the frame after it does the same, because it
    // takes what was read in between.
    const std::vector<PageChange>& begin_frame(bool is_bounded, Arrive arrive = Arrive::at_once);
    void set_most_bytes_a_frame(size_t bytes);
    // Returns the blocks of the frame's changes to the pool, after their bytes were
    // copied.
    void release();
    // Two-step version of release(), for callers that copy asynchronously:
    // take_blocks() removes the blocks from the frame, give_back() returns them after
    // the copy.
    std::vector<unsigned char*> take_blocks();
    void give_back(const std::vector<unsigned char*>& blocks);

    // Lends memory for the needs of the frame that began last. The caller returns it
    // with note_needs() or give_up().
    FrameNeeds* lend_needs();
    // If several views are noted before the pool decides, the last one counts. With
    // `waits`, returns after the pool has decided about this view, with the number of
    // pages that its cut missed; else returns an empty result at once. Only the caller
    // knows what its cut missed: a page that arrives between the cut and this call is
    // resident for the pool, but the pages below it were not requested.
    NotedView note_needs(FrameNeeds* needs, bool waits);
    void give_up(FrameNeeds* needs);  // for a frame without a cut
    // Returns the least tolerance of the frame that began last: smaller tolerances are
    // raised to it. 0 raises nothing.
    float least_tolerance_px2() const;
    // Raises the least tolerance above `tolerance_px2` at once, unless the needs of the
    // last view fit. Between frames the least tolerance changes only a little; this
    // function is for pictures that must not depend on the frames before them. Returns
    // whether it raised the tolerance.
    bool raise_tolerance_at_once(float tolerance_px2);
    // Begins to settle: forgets the needs of earlier frames, which could change the
    // tolerance later, the pages that failed, and the raised tolerance. Must not be
    // called between begin_frame() and note_needs().
    void begin_settling();
    // Throws std::runtime_error in a child of fork().
    void check_process() const;

    // Waits until there are pages to bring, nothing is left to read, or the time is up.
    // Returns whether there are pages to bring.
    bool wait(double seconds);
    // Reads the most urgent page in the calling thread. Returns whether there was one.
    bool read_one();
    // Returns the state after the last view that was decided about. Waits for the mutex
    // only if pages failed.
    PoolStatus status() const;

  private:
    struct State;
    const std::shared_ptr<State> state_;  // shared with the threads of the pool
};

}  // namespace v3dg
