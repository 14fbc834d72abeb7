#pragma once

// The inputs and outputs of a page pool: its limits, the page requests of a frame, and
// the state that it reports.

#include <cstdint>
#include <string>

#include "residency/page_policy.h"

namespace v3dg {

struct PoolLimits {
    PoolMemory memory;
    // Whether slots hold codes instead of rows. Requires that all pages are coded.
    bool keeps_codes = false;
    // Memory for pages that were read and are not resident yet.
    size_t block_bytes = size_t(64) << 20;
    // Maximum size of the pages that become resident in a frame. Can be changed later.
    size_t most_bytes_a_frame = size_t(32) << 20;
    // Maximum number of frames that hold memory for page requests at the same time.
    size_t most_frames = 1;
    // Number of reading threads. If it is 0, read_one() reads, and the calling threads
    // decide.
    unsigned num_threads = 8;
};

// The pages that the cut of a frame needs, absent or resident, in any order.
struct FrameNeeds {
    PageRequest* list;    // has room for PagePool::most_needs() elements
    size_t count;         // length of the list
    size_t num_left_out;  // number of needs that did not fit in the list
    float tolerance_px2;  // tolerance of the frame
    bool adapts;          // whether the pool may adapt the smallest tolerance
    float least_px2;      // smallest tolerance of the frame, set by lend_needs()
    uint64_t view;        // number of the view, set by note_needs()
};

// The result of waiting for the decision about a view.
struct NotedView {
    // Whether the pool has decided about this view. If so, status() describes it.
    bool is_decided = false;
    size_t num_absent = 0;  // number of pages that the cut missed
};

// One step towards a view whose pages are all resident. It selects a cut, but draws
// nothing.
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
        // Smaller tolerances are raised to this value, so that a view fits. 0 means
        // that none is raised.
        least_tolerance_px2;
    std::string error;  // error of the page that failed last
    bool is_damage;     // whether the file is damaged (see PageError)
};

}  // namespace v3dg
