#pragma once

// What goes into a pool of pages and what comes out of it: its limits, the needs of a frame, and
// the state that it reports.

#include <cstdint>
#include <string>

#include "residency/page_policy.h"

namespace v3dg {

struct PoolLimits {
    PoolMemory memory;
    bool keeps_codes = false;               // slots hold codes, else rows; all pages are coded
    size_t block_bytes = size_t(64) << 20;  // for pages that are read and not resident yet
    size_t most_bytes_a_frame = size_t(32) << 20;  // that become resident; it may be changed later
    size_t most_frames = 1;  // that borrow memory for their needs at the same time
    // Threads that read. With 0, read_one() reads and the calling threads decide.
    unsigned num_threads = 8;
};

// What the cut of a frame needs, absent or resident, in any order.
struct FrameNeeds {
    PageRequest* list;    // has room for most_needs()
    size_t count;         // number of entries
    size_t num_left_out;  // needs that there was no room for
    float tolerance_px2;  // with which the frame was drawn
    bool adapts;          // the least tolerance is adapted from frame to frame
    float least_px2;      // least tolerance of the frame; lend_needs() sets it
    uint64_t view;        // number of the view; note_needs() sets it
};

// The result of waiting for the decision about a view.
struct NotedView {
    bool is_decided = false;  // the pool has decided about this view, and status() describes it
    size_t num_absent = 0;    // pages that its cut missed
};

// A step towards a settled view, whose cut was computed without drawing it.
struct SettlingStep {
    float tolerance_px2 = 0;  // with which the cut was computed
    NotedView noted;
};

struct PoolStatus {
    size_t num_slots;
    size_t num_resident;  // slots that hold a page
    size_t needed;        // slots that the last view would take
    size_t missing;       // pages that the last view misses
    size_t failed;        // pages that cannot be read
    size_t pages_in;      // pages that became resident since the pool was made
    size_t bytes_in;      // their bytes
    float
        least_tolerance_px2;  // to which the tolerance is raised so that a view fits; 0: it is not
    std::string error;        // of the page that failed last
    bool is_damage;           // whether that was a damaged file, as in PageError
};

}  // namespace v3dg
