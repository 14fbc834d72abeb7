#pragma once

// A pool of pages in memory of a fixed size, for any device. The pool reads pages as
// bytes; the drawing code copies these to slots.
//
// In each frame, the drawing thread passes the page requests of its cut to the pool,
// and gets the pages that arrive and leave. The threads of the pool decide about pages
// (page_policy.h), and read pages into blocks. A mutex protects the exchange, and is
// held only to swap buffers. A frame that finds it locked continues without an
// exchange. pool_shared.h documents which thread owns which fields, and which may wait.

#include <memory>
#include <vector>

#include "quantize/quantize.h"
#include "residency/page_arrivals.h"
#include "residency/page_blocks.h"
#include "residency/page_policy.h"
#include "residency/pool_types.h"

namespace v3dg {

// begin_frame(), take_blocks(), give_back(), release(), lend_needs(), note_needs(),
// give_up() and begin_settling() must be called by one thread at a time. Every function
// that locks the mutex throws std::runtime_error in a child of fork().
class PagePool {
  public:
    // Reads the coarsest pages. Throws PageError if one cannot be read, and
    // std::invalid_argument if the memory has no room for the coarsest page and one
    // more page of each bundle.
    PagePool(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
             std::shared_ptr<BlockMemory> memory);
    ~PagePool();
    PagePool(const PagePool&) = delete;
    PagePool& operator=(const PagePool&) = delete;

    size_t num_bundles() const;
    const SlotPlan& plan() const;
    bool keeps_codes() const;
    int max_sh_degree() const;
    // Returns PageTable::shift on the host, [P], after the changes of the current
    // frame.
    Span<const int64_t> shift(size_t bundle) const;
    Span<const int32_t> begins(size_t bundle) const;
    const PageArrivals& arrivals() const;
    const PageSource& source(uint32_t bundle) const;
    // Returns the slot and the content of an arriving page. The pool must keep codes.
    SlotPage slot_page(const PageChange& change) const;
    // Returns the total bytes of all blocks and of the coarsest pages.
    size_t most_bytes_on_their_way() const;
    // Returns the largest number of page changes in a frame.
    size_t most_changes() const;
    // Returns the largest number of page requests per view, including pages that are
    // requested ahead.
    size_t most_needs() const;

    // Begins a frame. Returns the pages that arrive and leave before it, in the order
    // in which they must be applied. In the first frame these are the coarsest pages.
    // The bytes of arriving pages are valid until release() or the next call.
    //
    // A bounded frame never waits. A frame that is not bounded takes all pages that
    // were read, waits until the pool has decided about them, and ends all fades. The
    // next frame ends all fades, too, because it takes the pages that were read in
    // between.
    const std::vector<PageChange>& begin_frame(bool is_bounded, Arrive arrive = Arrive::at_once);
    void set_most_bytes_a_frame(size_t bytes);
    // Gives the blocks of the frame's changes back to the pool. Call this after the
    // bytes were copied.
    void release();
    // Two-step version of release(), for callers that copy asynchronously.
    // take_blocks() removes the blocks from the frame; give_back() gives them back
    // after the copy.
    std::vector<unsigned char*> take_blocks();
    void give_back(const std::vector<unsigned char*>& blocks);

    // Returns memory for the page requests of the current frame. The caller gives it
    // back by note_needs() or give_up().
    FrameNeeds* lend_needs();
    // Passes the page requests of a frame to the pool. If several views are passed
    // before the pool decides, the last one counts. If `waits`, the function returns
    // after the decision, with the number of pages that the cut missed; otherwise it
    // returns an empty result at once.
    //
    // The pages that the cut missed are counted as of the cut. A page may arrive
    // between the cut and this call; then the pages below it were not requested yet.
    NotedView note_needs(FrameNeeds* needs, bool waits);
    void give_up(FrameNeeds* needs);  // gives the memory back without page requests
    // Returns the smallest tolerance of the current frame. Smaller tolerances are
    // raised to it. 0 raises nothing.
    float least_tolerance_px2() const;
    // Raises the smallest tolerance above `tolerance_px2` at once, unless the pages of
    // the last view fit into the pool. Returns whether it did. Normally, the smallest
    // tolerance changes slowly from frame to frame. This function is for pictures that
    // must not depend on earlier frames.
    bool raise_tolerance_at_once(float tolerance_px2);
    // Begins to settle a view. Discards the page requests of earlier frames, which
    // could change the tolerance later; the record of pages that failed; and the raised
    // tolerance. Must not be called between begin_frame() and note_needs().
    void begin_settling();
    // Throws std::runtime_error in a child of fork().
    void check_process() const;

    // Waits until pages can arrive, nothing is left to read, or the time is over.
    // Returns whether pages can arrive.
    bool wait(double seconds);
    // Reads the most urgent page in the calling thread. Returns whether there was one.
    bool read_one();
    // Returns the state of the pool after its last decision. Waits for the mutex only
    // if pages have failed.
    PoolStatus status() const;

  private:
    struct State;
    const std::shared_ptr<State> state_;  // shared with the threads of the pool
};

}  // namespace v3dg
