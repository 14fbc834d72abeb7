#pragma once

// Pages in memory of a fixed size, the same for every device. It knows them as bytes that are
// brought somewhere; whoever draws brings them to their slots.
//
// A frame hands over what its cut needed and takes the pages that are to come and go before it.
// Threads of the pool's own decide which those are (page_policy.h) and read them into blocks. They
// share with frames a lock that is held for swaps of buffers only, and a frame that finds it taken
// does without.

#include <memory>
#include <string>
#include <vector>

#include "quantize/quantize.h"
#include "residency/page_arrivals.h"
#include "residency/page_blocks.h"
#include "residency/page_policy.h"

namespace v3dg {

struct PoolLimits {
    PoolMemory memory;
    bool keeps_codes = false;                      // of pages, all of which are coded; else rows
    size_t block_bytes = size_t(64) << 20;         // for what has been read and is not resident yet
    size_t most_bytes_a_frame = size_t(32) << 20;  // that become resident, at first
    size_t most_frames = 1;                        // that borrow memory for their needs at once
    unsigned num_threads =
        8;  // that read; none: read_one() does, and all is decided in threads that call
};

// What the cut of a frame needed, absent or resident, in any order.
struct FrameNeeds {
    PageRequest* list;    // room for most_needs()
    size_t count;         // there
    size_t num_left_out;  // more than there is room for
    float tolerance_px2;  // that it was drawn with
    bool adapts;          // the tolerance follows, from frame to frame
    uint32_t frame;       // which lend_needs() tells
    float least_px2;      // its least tolerance, likewise
    uint64_t view;        // the number of the view, which note_needs() sets
};

// What became of the needs of a view that was waited for.
struct NotedView {
    bool is_decided = false;  // the pool knows what this view needs, and status() is about it
    size_t num_absent = 0;    // pages that its cut missed
};

// A step towards a settled view: its cut was found without drawing it.
struct SettlingStep {
    float tolerance_px2 = 0;  // that the cut was found with
    NotedView noted;
};

struct PoolStatus {
    size_t num_slots, num_resident;  // slots, and those that hold a page
    size_t needed;                   // slots that the last view would take
    size_t missing;                  // pages that the last view misses
    size_t failed;                   // pages that cannot be had
    size_t pages_in, bytes_in;       // that became resident, ever
    float
        least_tolerance_px2;  // what the tolerance is raised to so that a view fits; 0: not raised
    std::string error;        // of the page that failed last
    bool is_damage;           // of a file, as PageError has it
};

// Frames are one thread at a time: begin_frame() to give_back(), lend_needs() and note_needs().
class PagePool {
  public:
    // Reads the coarsest pages. Throws PageError, or std::invalid_argument where there is no room
    // for those and one page more of each bundle.
    PagePool(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
             std::shared_ptr<BlockMemory> memory);
    ~PagePool();
    PagePool(const PagePool&) = delete;
    PagePool& operator=(const PagePool&) = delete;

    size_t num_bundles() const;
    const SlotPlan& plan() const;
    bool keeps_codes() const;
    int max_sh_degree() const;
    // [P] of the host's PageTable; as of the last changes that were taken.
    Span<const int64_t> shift(size_t bundle) const;
    Span<const int32_t> begins(size_t bundle) const;
    const PageArrivals& arrivals() const;
    const PageSource& source(uint32_t bundle) const;
    // What becomes of a page that comes, where codes are kept.
    SlotPage slot_page(const PageChange& change) const;
    // Of all that blocks and the coarsest pages hold together.
    size_t most_bytes_on_their_way() const;
    size_t most_changes() const;  // of a frame
    // Of a view that the pool has room for: what it needs, and what clusters of that ask for ahead.
    size_t most_needs() const;

    // Begins a frame: what comes and goes before it, in this order. The first time the coarsest
    // pages come. Their bytes stay until release() or the next call. A bounded frame waits for
    // nothing; one that is not takes all that was read, and waits until that is decided, and ends
    // all that fades in, as the next one does: what was read since comes in with that.
    const std::vector<PageChange>& begin_frame(bool is_bounded, Arrive arrive = Arrive::at_once);
    void set_most_bytes_a_frame(size_t bytes);
    void release();
    // The same in two steps, for who copies later: takes away the blocks, which give_back()
    // returns.
    std::vector<unsigned char*> take_blocks();
    void give_back(const std::vector<unsigned char*>& blocks);

    // Memory for what the frame needs that began last, which note_needs() returns.
    FrameNeeds* lend_needs();
    // Of several frames that are noted before one is decided about, the last one counts. If
    // `waits`, returns after the pool has decided about this view, with what its cut missed; else
    // at once, with an empty result. Only the caller knows what its cut missed: a page that arrives
    // between the cut and this call is resident for the pool, but the pages below it were not asked
    // for.
    NotedView note_needs(FrameNeeds* needs, bool waits);
    void give_up(FrameNeeds* needs);  // of a frame without a cut
    // What the tolerance of the frame that began last is raised to; 0: it is not.
    float least_tolerance_px2() const;
    // Raises the tolerance at once, unless there is room for what the last view needs: for a
    // picture that shall not depend on the frames before, from one to the next of which it changes
    // little. Returns whether it did.
    bool raise_tolerance_at_once(float tolerance_px2);
    // Begins to settle: forgets what earlier frames needed, which would otherwise change the
    // tolerance later, which pages failed, and what the tolerance was raised to. Not between
    // begin_frame() and note_needs().
    void begin_settling();
    void check_process() const;  // Throws std::runtime_error in a child of fork().

    // Waits until there is something to bring, nothing is left to be read, or time is up. Returns
    // whether there is something to bring.
    bool wait(double seconds);
    // Reads the most urgent page in this thread. Returns whether there was one.
    bool read_one();
    // Of the last view that was decided about. Waits for nothing, unless pages failed.
    PoolStatus status() const;

  private:
    struct State;
    const std::shared_ptr<State> state_;  // which threads share
};

}  // namespace v3dg
