#pragma once

// The inputs and outputs of a page pool: its limits, the page requests of a frame, and
// the state that it reports.

#include <cstdint>
#include <string>

#include "residency/page_policy.h"

namespace v3dg {

struct PoolLimits {
    PoolMemory memory;
    // Slots have codes instead of rows; all pages must be coded.
    bool keeps_codes = false;
    // Memory for pages that were read and are not resident yet.
    size_t block_bytes = size_t(64) << 20;
    // Bytes of pages that become resident per frame; can be changed later.
    size_t most_bytes_a_frame = size_t(32) << 20;
    // Number of frames that may hold memory for page requests at once.
    size_t most_frames = 1;
    // The number of reading threads. 0: read_one() reads, and the calling threads
    // decide.
    unsigned num_threads = 8;
};

// The pages that the cut of a frame needs, absent or resident, in any order.
struct FrameNeeds {
    PageRequest* list;    // has room for PagePool::most_needs() elements
    size_t count;         // length of the list
    size_t num_left_out;  // needs for which the list had no room
    float tolerance_px2;  // tolerance of the frame
    bool adapts;          // whether the pool may adapt the smallest tolerance
    float least_px2;      // smallest tolerance of the frame; lend_needs() sets it
    uint64_t view;        // number of the view; note_needs() sets it
};

// The result of waiting for the decision about a view.
struct NotedView {
    // Whether the pool has decided about this view, so that status() describes it.
    bool is_decided = false;
    size_t num_absent = 0;  // number of pages that the cut missed
};

// One step towards a view whose pages are all resident. The cut was not drawn.
struct SettlingStep {
    float tolerance_px2 = 0;  // tolerance of the cut
    NotedView noted;
};

struct PoolStatus {
    size_t num_slots;
    size_t num_resident;  // slots that hold a page
    size_t needed;        // slots that the last view would use
    size_t missing;       // pages that the last view misses
    size_t failed;        // pages that cannot be read
    size_t pages_in;      // pages that have become resident since the start
    size_t bytes_in;      // total bytes of pages_in
    float
        // Smaller tolerances are raised to this value, so that a view fits; 0: not
        // raised.
        least_tolerance_px2;
    std::string error;  // error of the page that failed last
    bool is_damage;     // whether that error is a damaged file (see PageError)
};

}  // namespace v3dg
