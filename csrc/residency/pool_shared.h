#pragma once

// What the threads of a page pool share: one mutex, the fields that it guards, and counters that
// are read without it.
//
// A pool has three owners, each with fields of its own in a file of its own:
//   PoolDecider (pool_decider.h)  one thread that decides which pages come and go
//   PoolReaders (pool_readers.h)  the threads that read pages into blocks
//   PoolFrames  (pool_frames.h)   the thread that draws
// They hand pages, blocks and needs to each other through the fields below. The mutex is held for
// swaps of buffers only: deciding and reading happen without it. A bounded frame never waits for
// the mutex: lock_at_once() gives up where another thread holds it, and the frame goes on without
// an exchange.
//
// Clang checks that fields are used and functions are called with the mutex that their annotations
// name (.ci/check_threads.py). Functions take PoolShared as an argument, so that a caller's mutex
// and a function's are recognised as the same one.

#include <sys/types.h>
#include <unistd.h>

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "base/mutex.h"
#include "residency/page_blocks.h"
#include "residency/page_policy.h"
#include "residency/pool_types.h"

namespace v3dg {

struct PoolShared {
    PoolShared(const PoolLimits& pool_limits, size_t num_slots);

    const PoolLimits limits;
    const pid_t process = getpid();
    // Else the threads that call decide and read.
    const bool has_threads;

    Mutex busy;
    Condition to_decide;    // there may be something to decide
    Condition to_read;      // there may be something to read, or a block for it
    Condition has_changed;  // a round or a page is over, or a thread has ended

    // Blocks and pages on their way: readers take blocks and fill `read`, the decider fills `todo`
    // and `ready`, frames take `ready` and give blocks back.
    PageBlocks blocks V3DG_GUARDED_BY(busy);
    std::vector<PageRequest> todo V3DG_GUARDED_BY(busy);  // the most urgent last
    std::vector<LoadedPage> read V3DG_GUARDED_BY(busy);   // the decider has not seen these
    std::vector<PageChange> ready V3DG_GUARDED_BY(busy);  // for the next frame
    size_t ready_bytes V3DG_GUARDED_BY(busy) = 0;
    size_t num_loading V3DG_GUARDED_BY(busy) = 0;      // pages that readers read now
    bool lacks_blocks V3DG_GUARDED_BY(busy) = false;   // a reader found no free block
    bool frees_readers V3DG_GUARDED_BY(busy) = false;  // the decider is to wake readers: waking
                                                       // them would take a frame too long

    // Needs of frames: frames set `noted`, the decider moves it to `free_needs`.
    FrameNeeds* noted V3DG_GUARDED_BY(busy) = nullptr;  // not decided about yet
    std::vector<FrameNeeds*> free_needs V3DG_GUARDED_BY(busy);
    uint64_t decided_view V3DG_GUARDED_BY(busy) = 0;  // the last view that was decided about
    bool has_noted V3DG_GUARDED_BY(busy) = false;     // since a frame took `ready`

    // Rounds of deciding.
    uint64_t rounds_begun V3DG_GUARDED_BY(busy) = 0;
    uint64_t rounds_over V3DG_GUARDED_BY(busy) = 0;
    bool wants_round V3DG_GUARDED_BY(busy) = false;  // a thread waits for the next round
    bool takes_all V3DG_GUARDED_BY(busy) = false;    // that round ignores most_bytes_a_frame
    size_t num_left V3DG_GUARDED_BY(busy) = 0;       // loaded pages that wait for a later frame

    // The end of the threads.
    bool is_over V3DG_GUARDED_BY(busy) = false;
    size_t num_threads V3DG_GUARDED_BY(busy) = 0;

    // The page that failed last.
    std::string error V3DG_GUARDED_BY(busy);
    bool is_damage V3DG_GUARDED_BY(busy) = false;

    // Any thread reads these without the mutex. Who writes them:
    std::atomic<size_t> most_bytes_a_frame;  // the caller
    std::atomic<size_t> needed{0};           // the decider
    std::atomic<size_t> missing;             // the decider
    std::atomic<size_t> failed{0};           // readers and forget_failures()
    std::atomic<size_t> num_resident{0};     // frames, as the next two
    std::atomic<size_t> pages_in{0};
    std::atomic<size_t> bytes_in{0};
    std::atomic<float> least_tolerance{0};  // the decider, or a caller that holds the mutex

    // Throws std::runtime_error in a child of fork(), where a thread that exists only in the parent
    // may have held the mutex: it would never be released here. Every function that callers of the
    // pool reach checks this before it takes the mutex.
    void check_process() const;
    // Checks the process, then takes the mutex and waits for it if need be.
    void lock() V3DG_ACQUIRE(busy);
    // Checks the process, then takes the mutex if it is free. Returns whether it did.
    bool lock_at_once() V3DG_TRY_ACQUIRE(true, busy);

    // Whether the decider may begin with the noted view. Pages that are ready for a frame were
    // needed by the last view or the one before, and must not be evicted before that frame has
    // them: the changes that a frame takes together bring at most one page to a slot.
    bool may_note() const V3DG_REQUIRES(busy);
    bool has_to_decide() const V3DG_REQUIRES(busy);
    bool is_deciding() const V3DG_REQUIRES(busy) { return rounds_begun != rounds_over; }
    // Whether nothing is left to decide and to read, or reading waits for blocks.
    bool is_idle() const V3DG_REQUIRES(busy);
};

// Holds the mutex of a pool for the rest of a scope, after the check of the process.
class V3DG_SCOPED_CAPABILITY PoolLock {
  public:
    explicit PoolLock(PoolShared& shared) V3DG_ACQUIRE(shared.busy) : shared_(shared) {
        shared.lock();
    }
    ~PoolLock() V3DG_RELEASE() { shared_.busy.unlock(); }
    PoolLock(const PoolLock&) = delete;
    PoolLock& operator=(const PoolLock&) = delete;

  private:
    PoolShared& shared_;
};

}  // namespace v3dg
