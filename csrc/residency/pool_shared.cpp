#include "residency/pool_shared.h"

#include <stdexcept>

namespace v3dg {

// A frame tries this often to lock the mutex before it continues without it.
constexpr int kSpins = 64;

PoolShared::PoolShared(const PoolLimits& pool_limits, size_t num_slots)
    : limits(pool_limits),
      has_threads(pool_limits.num_threads > 0 && num_slots > 0),
      most_bytes_a_frame(pool_limits.most_bytes_a_frame),
      // A number above 0 makes pages count as missing until the pool has decided about
      // the first view.
      missing(num_slots == 0 ? 0 : 1) {}

void PoolShared::check_process() const {
    if (process_id() != process)
        throw std::runtime_error(
            "memory: this renderer is from before a fork; create a new one in this process");
}

void PoolShared::lock() {
    check_process();
    busy.lock();
}

bool PoolShared::lock_at_once() {
    check_process();
    for (int k = 0; k <= kSpins; ++k)
        if (busy.try_lock()) return true;
    return false;
}

bool PoolShared::may_note() const { return noted != nullptr && (!has_noted || ready.empty()); }

bool PoolShared::has_to_decide() const {
    const bool has_pages = num_left > 0 || !read.empty();
    return wants_round || may_note() || frees_readers ||
           (has_pages && ready_bytes < most_bytes_a_frame);
}

bool PoolShared::is_idle() const {
    const bool is_decided = !has_threads || (!has_to_decide() && !is_deciding());
    return is_decided && (lacks_blocks || (todo.empty() && num_loading == 0));
}

}  // namespace v3dg
