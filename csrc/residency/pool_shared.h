#pragma once

// The state that the threads of a page pool share: one mutex, the fields that it
// guards, and counters that are read without it.
//
// A pool has three parts, each with its own fields in its own file:
//   PoolDecider (pool_decider.h)  one thread that decides which pages arrive and leave
//   PoolReaders (pool_readers.h)  the threads that read pages into blocks
//   PoolFrames  (pool_frames.h)   the drawing thread
// They exchange pages, blocks and needs through the fields below. The mutex is held
// only to swap buffers: deciding and reading happen without it. A bounded frame never
// waits for the mutex: lock_at_once() gives up if another thread holds it, and the
// frame goes on without an exchange.
//
// Clang checks that the mutexes named by annotations are held where fields are used and
// functions are called (.ci/check_threads.py). Functions take PoolShared as an
// argument, so that clang recognises the caller's mutex and the function's as the same.

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
    // If false, the threads that call the pool also decide and read.
    const bool has_threads;

    Mutex busy;
    Condition to_decide;    // there may be something to decide
    Condition to_read;      // there may be something to read, or a block for it
    Condition has_changed;  // a round or a page is over, or a thread has ended

    // Blocks and pages in transit: readers take blocks and fill `read`, the decider
    // fills `todo` and `ready`, frames take `ready` and return blocks.
    PageBlocks blocks V3DG_GUARDED_BY(busy);
    std::vector<PageRequest> todo V3DG_GUARDED_BY(busy);  // most urgent last
    std::vector<LoadedPage> read V3DG_GUARDED_BY(busy);   // not yet seen by the decider
    std::vector<PageChange> ready V3DG_GUARDED_BY(busy);  // for the next frame
    size_t ready_bytes V3DG_GUARDED_BY(busy) = 0;
    size_t num_loading V3DG_GUARDED_BY(busy) = 0;     // pages that are being read
    bool lacks_blocks V3DG_GUARDED_BY(busy) = false;  // a reader found no free block
    // The decider wakes readers, because waking them would take a frame too long.
    bool frees_readers V3DG_GUARDED_BY(busy) = false;

    // The needs of frames: frames set `noted`, the decider moves it to `free_needs`.
    FrameNeeds* noted V3DG_GUARDED_BY(busy) = nullptr;  // not decided about yet
    std::vector<FrameNeeds*> free_needs V3DG_GUARDED_BY(busy);
    uint64_t decided_view V3DG_GUARDED_BY(busy) = 0;  // the last view that was decided about
    // Whether a view was noted since a frame took `ready`.
    bool has_noted V3DG_GUARDED_BY(busy) = false;

    // Counts and requests of decision rounds.
    uint64_t rounds_begun V3DG_GUARDED_BY(busy) = 0;
    uint64_t rounds_over V3DG_GUARDED_BY(busy) = 0;
    bool wants_round V3DG_GUARDED_BY(busy) = false;  // a thread waits for the next round
    bool takes_all V3DG_GUARDED_BY(busy) = false;    // that round ignores most_bytes_a_frame
    size_t num_left V3DG_GUARDED_BY(busy) = 0;       // loaded pages that wait for a later frame

    // Set when the threads are to end.
    bool is_over V3DG_GUARDED_BY(busy) = false;
    size_t num_threads V3DG_GUARDED_BY(busy) = 0;

    // Describes the page that failed last.
    std::string error V3DG_GUARDED_BY(busy);
    bool is_damage V3DG_GUARDED_BY(busy) = false;

    // Any thread reads these without the mutex. The comments say who writes them.
    std::atomic<size_t> most_bytes_a_frame;  // the caller
    std::atomic<size_t> needed{0};           // the decider
    std::atomic<size_t> missing;             // the decider
    std::atomic<size_t> failed{0};           // readers and forget_failures()
    std::atomic<size_t> num_resident{0};     // frames, as for the next two
    std::atomic<size_t> pages_in{0};
    std::atomic<size_t> bytes_in{0};
    std::atomic<float> least_tolerance{0};  // the decider, or a caller that holds the mutex

    // Throws std::runtime_error in a child of fork(). There, a thread that exists only
    // in the parent may have held the mutex, which would never be released. Every
    // function that callers of the pool reach checks this before it locks the mutex.
    void check_process() const;
    // Checks the process, then locks the mutex, waiting if necessary.
    void lock() V3DG_ACQUIRE(busy);
    // Checks the process, then locks the mutex if it is free. Returns whether it did.
    bool lock_at_once() V3DG_TRY_ACQUIRE(true, busy);

    // Whether the decider may begin with the noted view. The pages in `ready` were
    // needed by the last view or the one before, and must not be evicted before the
    // next frame takes them, because the changes that a frame takes together bring at
    // most one page to a slot.
    bool may_note() const V3DG_REQUIRES(busy);
    bool has_to_decide() const V3DG_REQUIRES(busy);
    bool is_deciding() const V3DG_REQUIRES(busy) { return rounds_begun != rounds_over; }
    // Whether nothing is left to decide and to read, or reading waits for blocks.
    bool is_idle() const V3DG_REQUIRES(busy);
};

// Holds the mutex of a pool for the rest of a scope, after checking the process.
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
