#pragma once

// A pool of pages in memory of a fixed size, for any device. It reads pages as bytes,
// which the drawing code then copies to slots.
//
// In each frame, the drawing thread passes the page requests of its cut to the pool,
// and gets the pages that arrive and leave. The threads of the pool decide about pages
// (page_policy.h), and read pages into blocks. A mutex protects the exchange. It is
// held only to swap buffers, and a frame that finds it locked continues without an
// exchange. pool_shared.h documents which thread owns which fields, and which thread
// may wait.

#include <memory>
#include <vector>

#include "quantize/quantize.h"
#include "residency/page_arrivals.h"
#include "residency/page_blocks.h"
#include "residency/page_policy.h"
#include "residency/pool_types.h"

namespace v3dg {

// Only one thread at a time may call begin_frame(), take_blocks(), give_back(),
// release(), lend_needs(), note_needs(), give_up() and begin_settling(). In a child of
// fork(), every function that locks the mutex throws std::runtime_error.
class PagePool {
  public:
    // Reads the coarsest pages. Throws PageError if one of them cannot be read. Throws
    // std::invalid_argument if the memory has no room for the coarsest page of each
    // bundle and one more page.
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
    // Returns the slot and the content of an arriving page. Precondition: the pool
    // keeps codes.
    SlotPage slot_page(const PageChange& change) const;
    // Returns the total size in bytes of all blocks and coarsest pages.
    size_t most_bytes_on_their_way() const;
    // Returns the largest number of page changes in a frame.
    size_t most_changes() const;
    // Returns the largest number of page requests per view, including pages that are
    // requested ahead.
    size_t most_needs() const;

    // Begins a frame. Returns the page changes before it, in the order in which they
    // must be applied. In the first frame, these are the coarsest pages. The bytes of
    // arriving pages are valid until release() or the next call.
    //
    // A bounded frame never waits. A frame that is not bounded takes all pages that
    // were read, waits until the pool has decided about them, and ends all fades. The
    // next frame also ends all fades, because it gets the pages that were read in
    // between.
    const std::vector<PageChange>& begin_frame(bool is_bounded, Arrive arrive = Arrive::at_once);
    void set_most_bytes_a_frame(size_t bytes);
    // Returns the blocks of the frame's changes to the pool. Call it after their bytes
    // were copied.
    void release();
    // Two-step version of release(), for callers that copy asynchronously.
    // take_blocks() removes the blocks from the frame, and give_back() returns them to
    // the pool after the copy.
    std::vector<unsigned char*> take_blocks();
    void give_back(const std::vector<unsigned char*>& blocks);

    // Returns memory for the page requests of the current frame. The caller must return
    // it with note_needs() or give_up().
    FrameNeeds* lend_needs();
    // Passes the page requests of a frame to the pool. If several views are passed
    // before the pool decides, only the last one counts. If `waits` is true, the
    // function waits for the decision, and returns the number of pages that the cut
    // missed. Otherwise it immediately returns an empty result.
    //
    // That number describes the time of the cut. A page may arrive between the cut and
    // this call; the pages below it were then not requested yet.
    NotedView note_needs(FrameNeeds* needs, bool waits);
    void give_up(FrameNeeds* needs);  // returns the memory without page requests
    // Returns the smallest tolerance of the current frame, to which smaller ones are
    // raised. 0 means that none is raised.
    float least_tolerance_px2() const;
    // If the pages of the last view do not fit into the pool, raises the smallest
    // tolerance above `tolerance_px2`, and returns true. Otherwise returns false.
    // Normally, the smallest tolerance changes slowly from frame to frame. This
    // function is for pictures that must not depend on earlier frames.
    bool raise_tolerance_at_once(float tolerance_px2);
    // Begins to settle a view. Discards everything that earlier frames left: their page
    // requests (which could change the tolerance later), the record of failed pages,
    // and the raised tolerance. Must not be called between begin_frame() and
    // note_needs().
    void begin_settling();
    // Throws std::runtime_error in a child of fork().
    void check_process() const;

    // Waits until pages can arrive, nothing is left to read, or the time is over.
    // Returns whether pages can arrive.
    bool wait(double seconds);
    // Reads the most urgent page in the calling thread. Returns false if there was
    // none.
    bool read_one();
    // Returns the state of the pool after its last decision. Locks the mutex only if
    // pages have failed.
    PoolStatus status() const;

  private:
    struct State;
    const std::shared_ptr<State> state_;  // shared with the threads of the pool
};

}  // namespace v3dg
