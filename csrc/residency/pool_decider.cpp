// The rounds of the decider. A round first takes page requests and loaded pages, with
// the mutex locked. It then decides without the mutex. Finally, it locks the mutex
// again and publishes the results.

#include "residency/pool_decider.h"

#include <algorithm>
#include <new>
#include <utility>

namespace v3dg {

// In each frame, the tolerance changes by at most the factor kToleranceStep. It may
// fall while less than the fraction kRoomyShare of the slots is needed.
constexpr float kToleranceStep = 1.02f;
constexpr double kRoomyShare = 0.7;

void PoolDecider::reserve(size_t num_blocks, size_t num_changes) {
    policy_.reserve(num_blocks);
    loaded_.reserve(num_blocks);
    coming_.dropped.reserve(num_blocks);
    coming_.changes.reserve(num_changes);
}

// Decides about the state at the beginning of the round, without locking the mutex.
// Changes that other threads make meanwhile belong to the next round.
void PoolDecider::decide(PoolShared& shared) {
    ++shared.rounds_begun;
    shared.wants_round = false;
    if (std::exchange(shared.frees_readers, false)) shared.to_read.notify_all();
    FrameNeeds* needs = shared.may_note() ? std::exchange(shared.noted, nullptr) : nullptr;
    shared.has_noted |= needs != nullptr;
    loaded_.insert(loaded_.end(), shared.read.begin(), shared.read.end());
    shared.read.clear();
    const size_t under_way = shared.num_loading + loaded_.size();
    const size_t most_bytes_ready = shared.takes_all ? SIZE_MAX : shared.most_bytes_a_frame.load();
    const size_t bytes_left = most_bytes_ready - std::min(most_bytes_ready, shared.ready_bytes);
    bool is_known = needs != nullptr;
    {
        const MutexUnlock unlocked(shared.busy);
        try {
            if (needs != nullptr) {
                policy_.note({needs->list, needs->count}, needs->num_left_out, shared.failed > 0);
                policy_.choose(under_way, chosen_);
            }
        } catch (const std::bad_alloc&) {
            is_known = false;  // The next frame requests the same pages again.
        }
        coming_.clear();
        if (bytes_left > 0)
            policy_.bring(loaded_, bytes_left, coming_);
        else
            coming_.num_left = loaded_.size();
    }
    if (is_known) {
        shared.todo.swap(chosen_);
        shared.decided_view = needs->view;
        shared.needed = policy_.needed();
        shared.missing = policy_.missing();
        if (needs->adapts) adapt_tolerance(shared, *needs);
    }
    if (needs != nullptr) shared.free_needs.push_back(needs);
    for (unsigned char* block : coming_.dropped) shared.blocks.give_back(block);
    shared.ready.insert(shared.ready.end(), coming_.changes.begin(), coming_.changes.end());
    shared.ready_bytes += coming_.bytes;
    shared.num_left = coming_.num_left;
    if (is_known || !coming_.dropped.empty()) shared.to_read.notify_all();
    ++shared.rounds_over;
    shared.has_changed.notify_all();
}

// Starts from the tolerance of the frame that reported its needs. Therefore several
// frames in flight cause only one step.
void PoolDecider::adapt_tolerance(PoolShared& shared, const FrameNeeds& needs) {
    const size_t slots = policy_.num_slots();
    const size_t needed = shared.needed;
    const float least = shared.least_tolerance;
    const bool is_roomy = static_cast<double>(needed) < kRoomyShare * static_cast<double>(slots);
    if (needed > slots)
        shared.least_tolerance = std::max(least, needs.tolerance_px2 * kToleranceStep);
    else if (is_roomy && needs.least_px2 >= needs.tolerance_px2)
        shared.least_tolerance = std::min(least, needs.least_px2 / kToleranceStep);
    else if (is_roomy && needs.least_px2 == least)
        shared.least_tolerance = 0;
}

void PoolDecider::decide_next_round(PoolShared& shared) {
    if (!shared.has_threads) return decide(shared);
    const uint64_t next = shared.rounds_begun + 1;
    shared.wants_round = true;
    shared.to_decide.notify_one();
    while (shared.rounds_over < next) shared.has_changed.wait(shared.busy);
}

void PoolDecider::decide_always(PoolShared& shared) {
    const MutexLock lock(shared.busy);
    while (!shared.is_over) {
        if (shared.has_to_decide())
            decide(shared);
        else
            shared.to_decide.wait(shared.busy);
    }
    --shared.num_threads;
    shared.has_changed.notify_all();
}

void PoolDecider::forget_failures(PoolShared& shared) {
    if (shared.failed.exchange(0) == 0) return;
    policy_.forget_failures();
    shared.error.clear();
}

}  // namespace v3dg
