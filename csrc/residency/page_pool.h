#pragma once

// Pages in memory of a fixed size, the same for every device. A pool treats pages as bytes that it
// reads; whoever draws brings them to their slots.
//
// A frame hands over what its cut needs and takes the pages that come and go before it. The pool's
// own threads decide which those are (page_policy.h) and read them into blocks. Frames and these
// threads share a mutex that is held for swaps of buffers only; a frame that finds it taken goes on
// without an exchange. pool_shared.h says which side has which fields and who may wait.

#include <memory>
#include <vector>

#include "quantize/quantize.h"
#include "residency/page_arrivals.h"
#include "residency/page_blocks.h"
#include "residency/page_policy.h"
#include "residency/pool_types.h"

namespace v3dg {

// begin_frame(), take_blocks(), give_back(), release(), lend_needs(), note_needs(), give_up() and
// begin_settling() are called by one thread at a time. Every function that reaches the mutex throws
// std::runtime_error in a child of fork().
class PagePool {
  public:
    // Reads the coarsest pages. Throws PageError, or std::invalid_argument if there is no room for
    // those and for one more page of each bundle.
    PagePool(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
             std::shared_ptr<BlockMemory> memory);
    ~PagePool();
    PagePool(const PagePool&) = delete;
    PagePool& operator=(const PagePool&) = delete;

    size_t num_bundles() const;
    const SlotPlan& plan() const;
    bool keeps_codes() const;
    int max_sh_degree() const;
    // [P] of the host's PageTable, with the changes of the frame that began last.
    Span<const int64_t> shift(size_t bundle) const;
    Span<const int32_t> begins(size_t bundle) const;
    const PageArrivals& arrivals() const;
    const PageSource& source(uint32_t bundle) const;
    // The slot of a page that comes, in a pool that keeps codes.
    SlotPage slot_page(const PageChange& change) const;
    // Bytes of all blocks and of the coarsest pages.
    size_t most_bytes_on_their_way() const;
    // Most changes of a frame.
    size_t most_changes() const;
    // Most needs of a view that the pool has room for, including the pages that it asks for ahead.
    size_t most_needs() const;

    // Begins a frame: returns the pages that come and go before it, in this order. The first frame
    // brings the coarsest pages. The bytes of pages that come stay valid until release() or the
    // next call. A bounded frame waits for nothing. A frame that is not bounded takes all pages
    // that were read, waits until the pool has decided about them, and ends all fades; so does the
    // frame after it, which takes what was read in between.
    const std::vector<PageChange>& begin_frame(bool is_bounded, Arrive arrive = Arrive::at_once);
    void set_most_bytes_a_frame(size_t bytes);
    // Gives back the blocks of the frame's changes, whose bytes were copied.
    void release();
    // Two-step version of release(), for callers that copy asynchronously: take_blocks() removes
    // the blocks from the frame, give_back() returns them after the copy.
    std::vector<unsigned char*> take_blocks();
    void give_back(const std::vector<unsigned char*>& blocks);

    // Lends memory for the needs of the frame that began last; note_needs() or give_up() returns
    // it.
    FrameNeeds* lend_needs();
    // Of several views that are noted before the pool decides, the last one counts. If `waits`,
    // returns after the pool has decided about this view, with the number of pages that its cut
    // missed; else at once, with an empty result. Only the caller knows what its cut missed: a page
    // that arrives between the cut and this call is resident for the pool, but the pages below it
    // were not asked for.
    NotedView note_needs(FrameNeeds* needs, bool waits);
    void give_up(FrameNeeds* needs);  // for a frame without a cut
    // The value that the tolerance of the frame that began last is raised to; 0: it is not.
    float least_tolerance_px2() const;
    // Raises the least tolerance to more than `tolerance_px2` at once, unless there is room for
    // what the last view needs. For pictures that must not depend on the frames before them: from
    // one frame to the next it changes only a little. Returns whether it did.
    bool raise_tolerance_at_once(float tolerance_px2);
    // Begins to settle: forgets the needs of earlier frames, which could change the tolerance
    // later, the pages that failed, and the raised tolerance. Not between begin_frame() and
    // note_needs().
    void begin_settling();
    // Throws std::runtime_error in a child of fork().
    void check_process() const;

    // Waits until there are pages to bring, nothing is left to read, or the time is up. Returns
    // whether there are pages to bring.
    bool wait(double seconds);
    // Reads the most urgent page in this thread. Returns whether there was one.
    bool read_one();
    // Describes the last view that was decided about. Waits for the mutex only if pages failed.
    PoolStatus status() const;

  private:
    struct State;
    const std::shared_ptr<State> state_;  // shared with the pool's threads
};

}  // namespace v3dg
