#pragma once

// The policy of residency, the same for every device: which pages are loaded, which make room, and in what
// order. It knows pages as bytes that are brought somewhere; whoever draws brings them to their slots.
//
// Memory is rows of gaussians: the coarsest pages of all bundles first, which stay, then slots that hold any
// other page. What is resident is closed towards the root at every moment: a page comes after the page above
// it, and goes when none below it is there.
//
// Threads read pages from their sources into blocks. A frame takes what has been read, of a bounded number of
// bytes, and waits for nothing; after its cut it says which pages it used and which it missed.

#include <condition_variable>
#include <memory>
#include <mutex>
#include <string>
#include <vector>

#include "residency/cluster_table.h"
#include "residency/page_source.h"

namespace v3dg {

// A bundle of which pages are resident: its tables, of which only those of groups and clusters are read and
// only at the start, and where its pages come from.
struct PagedBundle {
    ClusterTable table;
    std::shared_ptr<const PageSource> source;
};

struct PoolLimits {
    size_t num_rows;                               // of memory
    size_t block_bytes = size_t(64) << 20;         // for what has been read and is not resident yet
    size_t most_bytes_a_frame = size_t(32) << 20;  // that become resident
    unsigned num_threads = 8;                      // none: pages are read by read_one() alone
};

// A page that comes to its slot, or leaves it.
struct PageChange {
    uint32_t bundle, page;
    int64_t row;                 // where its rows begin; kAbsentPage: it leaves
    const unsigned char* bytes;  // of what comes
};

// Where blocks of bytes come from; kinds of memory differ by device.
struct BlockMemory {
    virtual ~BlockMemory() = default;
    virtual unsigned char* allocate(size_t bytes) = 0;  // lives as long as this
};

struct PoolStatus {
    size_t num_slots, num_resident;  // slots, and those that hold a page
    size_t needed;                   // slots that the last view would take
    size_t missing;                  // pages that the last view misses
    size_t failed;                   // pages that cannot be had
    size_t pages_in, bytes_in;       // that became resident, ever
    float least_tolerance_px2;       // what the tolerance is raised to so that a view fits; 0: not raised
    std::string error;               // of the page that failed last
    bool is_damage;                  // of a file, as PageError has it
};

class PagePool {
  public:
    // Reads the coarsest pages. Throws PageError, or std::invalid_argument where there is no room for those
    // and one page more of each bundle.
    PagePool(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
             std::shared_ptr<BlockMemory> memory);
    ~PagePool();
    PagePool(const PagePool&) = delete;
    PagePool& operator=(const PagePool&) = delete;

    size_t num_bundles() const;
    size_t slot_rows() const;
    size_t first_slot_row() const;
    size_t num_slots() const;
    int max_sh_degree() const;
    // [P] of the host's PageTable; as of the last changes that were taken.
    Span<const int64_t> shift(size_t bundle) const;
    const PageSource& source(uint32_t bundle) const;
    // Of all that blocks and the coarsest pages hold together.
    size_t most_bytes_on_their_way() const;
    size_t most_changes() const;  // of a frame
    // Of a view that the pool has room for: what it needs, and what clusters of that ask for ahead.
    size_t most_needs() const;

    // Begins a frame: what comes and goes before it, in this order. The first time the coarsest pages come.
    // Their bytes stay until release() or the next call.
    const std::vector<PageChange>& begin_frame(bool is_bounded);
    void release();
    // The same in two steps, for who copies later: takes away the blocks, which give_back() returns.
    std::vector<unsigned char*> take_blocks();
    void give_back(const std::vector<unsigned char*>& blocks);

    // The number of the frame that began last.
    uint32_t frame() const;
    // What the cut of a frame needed, absent or resident, in any order. `tolerance_px2` is what it was drawn
    // with; `adapts`: the tolerance follows, from frame to frame. So many more pages are needed as are left
    // out, which is more than there is room for.
    void note_needs(uint32_t frame, Span<const PageRequest> needs, size_t num_left_out, float tolerance_px2,
                    bool adapts);
    // Raises the tolerance at once, unless there is room for what the last view needs: for a picture that
    // shall not depend on the frames before, from one to the next of which it changes little. Returns whether
    // it did.
    bool raise_tolerance_at_once(float tolerance_px2);
    void reset_tolerance();

    // Waits until there is something to bring, nothing is left to be read, or time is up. Returns whether
    // there is something to bring.
    bool wait(double seconds);
    // Reads the most urgent page in this thread. Returns whether there was one.
    bool read_one();
    // Forgets which pages failed, so that they are tried again.
    void forget_failures();
    PoolStatus status() const;

  private:
    struct State;
    const std::shared_ptr<State> state_;  // which threads share
};

}  // namespace v3dg
