#pragma once

// The state that the threads of a page pool share: a mutex, the fields that it guards,
// and atomic counters.
//
// A pool has three parts, each with its own fields in its own file:
//   PoolDecider (pool_decider.h)  one thread that decides which pages arrive and leave
//   PoolReaders (pool_readers.h)  the threads that read pages into blocks
//   PoolFrames  (pool_frames.h)   the drawing thread
// The parts exchange pages, blocks and page requests through the fields below. The
// mutex is locked only to swap buffers; deciding and reading happen without it. A
// bounded frame never waits for the mutex: if lock_at_once() fails, the frame continues
// without an exchange.
//
// Annotations name the mutex of each field and function, and clang checks them
// (.ci/check_threads.py). Functions take PoolShared as an argument, so that clang can
// see that the caller and the function use the same mutex.

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "base/mutex.h"
#include "base/process.h"
#include "residency/page_blocks.h"
#include "residency/page_policy.h"
#include "residency/pool_types.h"

namespace v3dg {

struct PoolShared {
    PoolShared(const PoolLimits& pool_limits, size_t num_slots);

    const PoolLimits limits;
    const int64_t process = process_id();
    // If false, the pool has no threads: those that call it also decide and read.
    const bool has_threads;

    Mutex busy;
    Condition to_decide;    // there may be something to decide
    Condition to_read;      // there may be something to read, or a block for it
    Condition has_changed;  // a round has ended, a page was read, or a thread has ended

    // Blocks, and pages between two parts. Readers take blocks and fill `read`. The
    // decider fills `todo` and `ready`. Frames take `ready` and return blocks.
    PageBlocks blocks V3DG_GUARDED_BY(busy);
    // The most urgent page is last.
    std::vector<PageRequest> todo V3DG_GUARDED_BY(busy);
    std::vector<LoadedPage> read V3DG_GUARDED_BY(busy);   // pages that the decider has
                                                          // not processed yet
    std::vector<PageChange> ready V3DG_GUARDED_BY(busy);  // for the next frame
    size_t ready_bytes V3DG_GUARDED_BY(busy) = 0;
    // Number of pages that are being read.
    size_t num_loading V3DG_GUARDED_BY(busy) = 0;
    bool lacks_blocks V3DG_GUARDED_BY(busy) = false;  // whether a reader found no free
                                                      // block
    // True if blocks were returned, so that the decider must wake the readers. The
    // frame does not wake them itself, because that would delay it.
    bool frees_readers V3DG_GUARDED_BY(busy) = false;

    // The page requests of a frame. Frames set `noted`, and the decider moves it to
    // `free_needs`.
    FrameNeeds* noted V3DG_GUARDED_BY(busy) = nullptr;  // not decided about yet
    std::vector<FrameNeeds*> free_needs V3DG_GUARDED_BY(busy);
    // The last view that the decider has processed.
    uint64_t decided_view V3DG_GUARDED_BY(busy) = 0;
    // Whether a view was recorded after a frame last took `ready`.
    bool has_noted V3DG_GUARDED_BY(busy) = false;

    // Number of rounds of the decider.
    uint64_t rounds_begun V3DG_GUARDED_BY(busy) = 0;
    uint64_t rounds_over V3DG_GUARDED_BY(busy) = 0;
    // Whether a thread waits for the next round.
    bool wants_round V3DG_GUARDED_BY(busy) = false;
    // Whether the next round ignores most_bytes_a_frame.
    bool takes_all V3DG_GUARDED_BY(busy) = false;
    // Number of loaded pages that wait for a later frame.
    size_t num_left V3DG_GUARDED_BY(busy) = 0;

    // Whether the threads must end.
    bool is_over V3DG_GUARDED_BY(busy) = false;
    size_t num_threads V3DG_GUARDED_BY(busy) = 0;

    // The error of the page that failed last.
    std::string error V3DG_GUARDED_BY(busy);
    bool is_damage V3DG_GUARDED_BY(busy) = false;

    // Any thread may read the fields below without locking the mutex. The comments name
    // the threads that write them.
    std::atomic<size_t> most_bytes_a_frame;  // written by the caller
    std::atomic<size_t> needed{0};           // written by the decider
    std::atomic<size_t> missing;             // written by the decider
    std::atomic<size_t> failed{0};           // written by readers and forget_failures()
    std::atomic<size_t> num_resident{0};     // written by frames, like the next two fields
    std::atomic<size_t> pages_in{0};
    std::atomic<size_t> bytes_in{0};
    // Written by the decider, or by a caller that holds the mutex.
    std::atomic<float> least_tolerance{0};

    // Throws std::runtime_error in a child of fork(). There, the mutex could stay
    // locked forever by a thread that exists only in the parent. Functions that callers
    // of the pool use must call this before they lock the mutex.
    void check_process() const;
    // Checks the process, then locks the mutex.
    void lock() V3DG_ACQUIRE(busy);
    // Checks the process, then tries to lock the mutex. Returns whether it was locked.
    bool lock_at_once() V3DG_TRY_ACQUIRE(true, busy);

    // Returns whether the decider may process the recorded view. While pages wait in
    // `ready`, it processes only one view. Therefore pages in `ready` were needed by
    // the last view or the one before, and they are not evicted before a frame takes
    // them. A slot can get only one page per frame.
    bool may_note() const V3DG_REQUIRES(busy);
    bool has_to_decide() const V3DG_REQUIRES(busy);
    bool is_deciding() const V3DG_REQUIRES(busy) { return rounds_begun != rounds_over; }
    // Returns whether there is nothing to decide, and nothing to read or no free block.
    bool is_idle() const V3DG_REQUIRES(busy);
};

// Locks the mutex of a pool until the end of the scope. The constructor also checks the
// process.
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
