#include "residency/page_arrivals.h"

#include <algorithm>

namespace v3dg {

// The value of begins_[page] for an evicted page that may still be in the list of
// waiting pages.
constexpr int32_t kHasLeft = kNeverBegins - 1;

PageArrivals::PageArrivals(const PagePolicy& policy)
    : policy_(policy), begins_(policy.num_pages()) {
    for (uint32_t page = 0; page < begins_.size(); ++page)
        begins_[page] = policy.page_above(page) < 0 ? kBegunLongAgo : kNeverBegins;
    waiting_.reserve(2 * policy.num_slots());
    changed_.reserve(2 * policy.num_slots());
}

void PageArrivals::advance(const std::vector<PageChange>& changes, Arrive arrive) {
    const bool fades = arrive == Arrive::fading;
    const size_t num_before = waiting_.size();
    changed_.clear();
    for (const PageChange& change : changes) {
        const uint32_t page = policy_.id_of(change.bundle, change.page);
        const int32_t above = policy_.page_above(page);
        if (above < 0) continue;
        begins_[page] = change.bytes == nullptr ? kHasLeft : kNeverBegins;
        if (change.bytes != nullptr) waiting_.push_back({page, static_cast<uint32_t>(above)});
    }
    frame_ = fades ? frame_ + 1 : std::max(frame_ + 1, last_begin_ + kArrivalFrames);
    size_t num_kept = 0;
    for (size_t i = 0; i < waiting_.size(); ++i) {
        const auto [page, above] = waiting_[i];
        // Skip the page if it was evicted, or if it arrived again and is already fading
        // in.
        if (begins_[page] != kNeverBegins) continue;
        const bool is_next = frame_ - begins_[above] >= kArrivalFrames;
        if (!fades)
            begins_[page] = kBegunLongAgo;
        else if (is_next)
            last_begin_ = begins_[page] = frame_ - 1;
        const bool waits = begins_[page] == kNeverBegins;
        if (waits) waiting_[num_kept++] = {page, above};
        if (!waits || i >= num_before) changed_.push_back({page, begins_[page]});
    }
    waiting_.resize(num_kept);
}

}  // namespace v3dg
