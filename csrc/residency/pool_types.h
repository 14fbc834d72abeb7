#pragma once

// The inputs and outputs of a page pool: its limits, the needs of a frame, and the
// state that it reports.

#include <cstdint>
#include <string>

#include "residency/page_policy.h"

namespace v3dg {

struct PoolLimits {
    PoolMemory memory;
    bool keeps_codes = false;  // slots hold codes instead of rows; all pages must be coded
    size_t block_bytes = size_t(64) << 20;  // for pages that are read and not yet resident
    // bytes that become resident per frame; may be changed later
    size_t most_bytes_a_frame = size_t(32) << 20;
    size_t most_frames = 1;  // frames that borrow memory for their needs at the same time
    // The number of reading threads. If 0, read_one() reads and the calling threads
    // decide.
    unsigned num_threads = 8;
};

// The pages that the cut of a frame needs, absent or resident, in any order.
struct FrameNeeds {
    PageRequest* list;    // has room for most_needs()
    size_t count;         // length of the list
    size_t num_left_out;  // needs that did not fit into the list
    float tolerance_px2;  // tolerance with which the frame was drawn
    bool adapts;          // whether the least tolerance is adapted from frame to frame
    float least_px2;      // least tolerance of the frame; lend_needs() sets it
    uint64_t view;        // number of the view; note_needs() sets it
};

// The result of waiting for the decision about a view.
struct NotedView {
    bool is_decided = false;  // the pool has decided about this view, and status() describes it
    size_t num_absent = 0;    // pages that its cut missed
};

// A step towards a settled view, whose cut was computed but not drawn.
struct SettlingStep {
    float tolerance_px2 = 0;  // tolerance of that cut
    NotedView noted;
};

struct PoolStatus {
    size_t num_slots;
    size_t num_resident;  // slots that hold a page
    size_t needed;        // slots that the last view would occupy
    size_t missing;       // pages that the last view misses
    size_t failed;        // pages that cannot be read
    size_t pages_in;      // pages that became resident since the pool was made
    size_t bytes_in;      // total size of those pages
    float
        // smaller tolerances are raised to this value so that a view fits; 0: not
        // raised
        least_tolerance_px2;
    std::string error;  // error of the page that failed last
    bool is_damage;     // whether a damaged file caused that error, as in PageError
};

}  // namespace v3dg
