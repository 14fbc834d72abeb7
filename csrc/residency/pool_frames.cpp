// The exchange between frames and the other threads of a pool. Also the tables of
// resident pages.

#include "residency/pool_frames.h"

#include <algorithm>
#include <utility>

#include "base/parallel_for.h"

namespace v3dg {

constexpr size_t kRootAlignment = 16;

PoolFrames::PoolFrames(const PagePolicy& policy, PoolDecider& decider, size_t num_bundles)
    : policy_(policy), decider_(decider), shift_(num_bundles), arrivals_(policy) {}

size_t PoolFrames::read_roots(BlockMemory& memory) {
    std::vector<size_t> first{0};
    for (uint32_t b = 0; b < num_bundles(); ++b) {
        const PageSource& source = policy_.source(b);
        const size_t root = source.num_pages() - 1;
        first.push_back(first.back());
        if (source.num_clusters() == 0) continue;
        changes_.push_back(policy_.root(b));
        first.back() +=
            (source.num_bytes(root) + kRootAlignment - 1) / kRootAlignment * kRootAlignment;
    }
    unsigned char* bytes = memory.allocate(std::max<size_t>(first.back(), 1));
    for (PageChange& change : changes_) change.bytes = bytes + first[change.bundle];
    parallel_for(num_bundles(), 1,
                 [&](size_t b) { shift_[b].assign(policy_.source(b).num_pages(), kAbsentPage); });
    parallel_for(changes_.size(), 1, [&](size_t k) {
        const PageChange& change = changes_[k];
        const PageSource& source = policy_.source(change.bundle);
        source.read(change.page, bytes + first[change.bundle]);
        shift_[change.bundle][change.page] = change.row - source.first_row(change.page);
    });
    return first.back();
}

void PoolFrames::reserve(size_t num_blocks, size_t num_changes, size_t num_frames,
                         size_t most_needs, BlockMemory& memory) {
    changes_.reserve(num_changes);
    taken_.reserve(num_blocks);
    returned_.reserve(num_blocks);
    // There are two more buffers than frames in flight: one waits for the decider, and
    // another is used by the decider.
    all_needs_.resize(num_frames + 2);
    for (FrameNeeds& needs : all_needs_) {
        needs.list =
            reinterpret_cast<PageRequest*>(memory.allocate(most_needs * sizeof(PageRequest)));
        idle_needs_.push_back(&needs);
    }
}

const std::vector<PageChange>& PoolFrames::begin_frame(PoolShared& shared, bool is_bounded,
                                                       Arrive arrive) {
    least_of_frame_ = shared.least_tolerance;
    const bool is_first = !std::exchange(has_begun_, true);
    // In the first frame, `changes_` already has the coarsest pages.
    if (!is_first) take_changes(shared, is_bounded);
    const bool is_after_look = std::exchange(has_looked_, !is_bounded);
    arrivals_.advance(changes_, is_bounded && !is_after_look ? arrive : Arrive::at_once);
    return changes_;
}

void PoolFrames::take_changes(PoolShared& shared, bool is_bounded) {
    changes_.clear();
    if (!is_bounded)
        shared.lock();
    else if (!shared.lock_at_once())
        return;
    {
        const MutexLock lock(shared.busy, std::adopt_lock);
        swap_changes(shared, is_bounded);
    }
    apply_changes(shared);
}

void PoolFrames::swap_changes(PoolShared& shared, bool is_bounded) {
    exchange(shared);
    if (!is_bounded || !shared.has_threads) {
        shared.takes_all = !is_bounded;
        decider_.decide_next_round(shared);
        shared.takes_all = false;
    }
    changes_.swap(shared.ready);
    shared.ready_bytes = 0;
    shared.has_noted = false;
    // A frame that is not bounded waits for the decision about its own view. If the
    // pool decided about an earlier view first, it would fill `ready`, and no other
    // view could be recorded before the next frame.
    if (!is_bounded) forget_noted(shared);
    if (shared.has_to_decide()) shared.to_decide.notify_one();
}

// Updates the tables for the changes of the frame, and keeps the blocks of these
// changes.
void PoolFrames::apply_changes(PoolShared& shared) {
    for (const PageChange& change : changes_) {
        const PageSource& source = policy_.source(change.bundle);
        if (change.bytes == nullptr) {
            shift_[change.bundle][change.page] = kAbsentPage;
            --shared.num_resident;
            continue;
        }
        shift_[change.bundle][change.page] = change.row - source.first_row(change.page);
        taken_.push_back(const_cast<unsigned char*>(change.bytes));
        ++shared.num_resident;
        ++shared.pages_in;
        shared.bytes_in += source.num_bytes(change.page);
    }
}

// Passes page requests and free blocks to the other threads. Takes back the memory of
// page requests that the pool has decided about.
void PoolFrames::exchange(PoolShared& shared) {
    if (to_note_ != nullptr) {
        if (shared.noted != nullptr) idle_needs_.push_back(shared.noted);
        shared.noted = std::exchange(to_note_, nullptr);
    }
    idle_needs_.insert(idle_needs_.end(), shared.free_needs.begin(), shared.free_needs.end());
    shared.free_needs.clear();
    for (unsigned char* block : returned_) shared.blocks.give_back(block);
    if (!returned_.empty() && shared.lacks_blocks) {
        shared.lacks_blocks = false;
        shared.frees_readers = true;
    }
    returned_.clear();
    if (shared.has_to_decide()) shared.to_decide.notify_one();
}

// Withdraws the recorded view, unless a round has already started with it.
void PoolFrames::forget_noted(PoolShared& shared) {
    if (shared.noted != nullptr) idle_needs_.push_back(std::exchange(shared.noted, nullptr));
}

std::vector<unsigned char*> PoolFrames::take_blocks() { return std::exchange(taken_, {}); }

void PoolFrames::give_back(PoolShared& shared, const std::vector<unsigned char*>& blocks) {
    returned_.insert(returned_.end(), blocks.begin(), blocks.end());
    if (!shared.lock_at_once()) return;
    const MutexLock lock(shared.busy, std::adopt_lock);
    exchange(shared);
}

FrameNeeds* PoolFrames::lend_needs() {
    if (idle_needs_.empty()) idle_needs_.push_back(std::exchange(to_note_, nullptr));
    FrameNeeds* needs = idle_needs_.back();
    idle_needs_.pop_back();
    needs->least_px2 = least_of_frame_;
    return needs;
}

NotedView PoolFrames::note_needs(PoolShared& shared, FrameNeeds* needs, bool waits) {
    if (to_note_ != nullptr) idle_needs_.push_back(to_note_);
    to_note_ = needs;
    const uint64_t view = ++num_views_;
    needs->view = view;
    NotedView noted;
    if (waits) noted.num_absent = count_absent(*needs);
    if (waits)
        shared.lock();
    else if (!shared.lock_at_once())
        return noted;
    const MutexLock lock(shared.busy, std::adopt_lock);
    exchange(shared);
    if (waits || !shared.has_threads) decider_.decide_next_round(shared);
    noted.is_decided = waits && shared.decided_view == view;
    return noted;
}

// Returns how many pages the cut missed, according to the tables of the frame.
size_t PoolFrames::count_absent(const FrameNeeds& needs) const {
    size_t count = needs.num_left_out;
    for (size_t k = 0; k < needs.count; ++k) {
        const PageRequest& need = needs.list[k];
        count += need.priority > 1 && shift_[need.bundle][need.page] == kAbsentPage;
    }
    return count;
}

void PoolFrames::begin_settling(PoolShared& shared) {
    const PoolLock lock(shared);
    exchange(shared);
    forget_noted(shared);
    // Wait, because a round in progress may change the tolerance when it ends.
    while (shared.is_deciding()) shared.has_changed.wait(shared.busy);
    decider_.forget_failures(shared);
    shared.least_tolerance = 0;
}

}  // namespace v3dg
