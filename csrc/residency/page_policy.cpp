// Implements the decisions of page_policy.h. note() marks resident pages as used, and
// collects absent pages. choose() sorts the absent pages for reading. bring() assigns
// slots to pages that were read, and evicts the least recently used pages.

#include "residency/page_policy.h"

#include <algorithm>
#include <cstring>
#include <functional>
#include <stdexcept>
#include <string>
#include <utility>

#include "base/parallel_for.h"

namespace v3dg {

namespace {

// The priority of a page is at least kAbove times the priority of each page below it.
constexpr float kAbove = 2.0f;
// The largest priority. Close to the eye, priorities have no upper bound. They are
// clamped, so that the page above can still have a higher priority.
constexpr float kMostPriority = 1073741824.0f;
// Maximum number of slots that one search selects for eviction.
constexpr size_t kMostLeaving = 4096;
constexpr size_t kMostChosen = size_t(1) << 14;  // number of pages to read before the
                                                 // next choice
constexpr int32_t kRootSlot = -2;
constexpr int32_t kNoSlot = -1;
constexpr size_t kAhead = 16;  // pages are prefetched this many needs ahead

// A key is a priority of at least 1/2, rounded down to a sixteenth of a power of two.
// It consists of the exponent of the float and the upper four of its 23 mantissa bits.
constexpr uint32_t kNumKeys = 1024;
constexpr uint32_t kKeyShift = 19;
constexpr uint32_t kFirstKey = 0x3f000000u >> kKeyShift;
// The key of priority 1. A page with a lower key is only requested ahead of use: the
// cut does not miss it.
constexpr uint32_t kKeyOfMissed = (0x3f800000u >> kKeyShift) - kFirstKey;

// The approximate number of bytes in a stretch. A stretch consists of adjacent pages
// that are read together, because disks are faster with large requests. Pages that are
// adjacent in the file are close in space and usually have equal levels, so their
// priorities are similar. The key of a stretch is the key of its most urgent wanted
// page.
constexpr size_t kStretchBytes = size_t(512) << 10;
constexpr uint32_t kNoStretch = UINT32_MAX;

uint32_t key_of(float priority) {
    uint32_t bits;  // bits of positive floats have the same order as the floats
    std::memcpy(&bits, &priority, sizeof bits);
    return std::clamp(bits >> kKeyShift, kFirstKey, kFirstKey + kNumKeys - 1) - kFirstKey;
}

}  // namespace

void PagesComing::clear() {
    changes.clear();
    dropped.clear();
    bytes = num_left = 0;
}

std::vector<int64_t> SlotPlan::empty_offsets() const {
    std::vector<int64_t> offset(first_slot_cluster, 0);
    for (size_t s = 0; s < num_slots; ++s)
        offset.insert(offset.end(), slot_clusters,
                      static_cast<int64_t>(first_slot_row + s * slot_rows));
    offset.push_back(static_cast<int64_t>(num_rows()));
    return offset;
}

PagePolicy::PagePolicy(const std::vector<PagedBundle>& bundles, const PoolMemory& memory)
    : places_of_key_(kNumKeys) {
    size_t num_pages = 0;
    for (const PagedBundle& bundle : bundles) num_pages += bundle.table.num_pages();
    if (num_pages > INT32_MAX)
        throw std::invalid_argument("memory: expected fewer than 2^31 pages in all bundles, got " +
                                    std::to_string(num_pages));
    slot_of_page_ = {slot_storage_.reserve(num_pages), num_pages};
    pages_ = {page_storage_.reserve(num_pages), num_pages};
    states_ = std::make_unique<std::atomic<PageState>[]>(num_pages);
    uint32_t first_page = 0;
    for (const PagedBundle& bundle : bundles) {
        bundles_.push_back({.source = bundle.source, .first_page = first_page});
        first_page += static_cast<uint32_t>(bundle.table.num_pages());
    }
    parallel_for(bundles.size(), 1, [&](size_t b) { add_pages(bundles_[b], bundles[b].table); });
    plan_memory(memory);
}

void PagePolicy::add_pages(Bundle& bundle, const ClusterTable& table) {
    const uint32_t first = bundle.first_page;
    const size_t root = table.num_pages() - 1;
    std::fill_n(slot_of_page_.data + first, root, kNoSlot);
    std::fill_n(pages_.data + first, root + 1, Page{});
    for (size_t c = 0; c < table.num_clusters(); ++c)
        if (table.own_group[c] >= 0)
            pages_[first + table.own_group[c]].parent =
                static_cast<int32_t>(first + table.page_of(c));
    slot_of_page_[first + root] = kRootSlot;
    if (table.num_clusters() > 0) states_[first + root] = PageState::resident;
    for (size_t p = 0; p < root; ++p) {
        bundle.most_rows = std::max(bundle.most_rows, bundle.source->num_rows(p));
        bundle.most_clusters = std::max(bundle.most_clusters, bundle.source->num_clusters(p));
        bundle.most_bytes = std::max(bundle.most_bytes, bundle.source->num_bytes(p));
    }
}

void PagePolicy::plan_memory(const PoolMemory& memory) {
    size_t num_pages = 0;
    for (Bundle& bundle : bundles_) {
        const size_t root = bundle.source->num_pages() - 1;
        bundle.root_row = plan_.first_slot_row;
        bundle.root_cluster = plan_.first_slot_cluster;
        plan_.first_slot_row += bundle.source->num_rows(root);
        plan_.first_slot_cluster += bundle.source->num_clusters(root);
        num_pages += root;
        plan_.slot_rows = std::max(plan_.slot_rows, bundle.most_rows);
        plan_.slot_clusters = std::max(plan_.slot_clusters, bundle.most_clusters);
        most_page_bytes_ = std::max(most_page_bytes_, bundle.most_bytes);
    }
    const size_t roots = memory.bytes_of(plan_.num_rows(), plan_.num_clusters());
    const size_t slot = memory.bytes_of(plan_.slot_rows, plan_.slot_clusters);
    const size_t least = roots + (num_pages > 0 ? bundles_.size() * slot : 0);
    if (memory.num_bytes < least || memory.most_rows < plan_.num_rows())
        throw std::invalid_argument("memory: expected at least " + std::to_string(least) +
                                    " bytes for gaussians (the coarsest page and one more page of "
                                    "each bundle), got " +
                                    std::to_string(memory.num_bytes));
    plan_.num_slots =
        std::min({(memory.num_bytes - roots) / slot,
                  (memory.most_rows - plan_.first_slot_row) / plan_.slot_rows, num_pages});
    slots_.resize(plan_.num_slots);
    uses_.resize(plan_.num_slots);
    leaving_.reserve(plan_.num_slots);
    for (size_t s = plan_.num_slots; s > 0; --s)
        free_slots_.push_back(static_cast<uint32_t>(s - 1));
}

PageChange PagePolicy::root(size_t bundle) const {
    const Bundle& paged = bundles_[bundle];
    return {.bundle = static_cast<uint32_t>(bundle),
            .page = static_cast<uint32_t>(paged.source->num_pages() - 1),
            .row = static_cast<int64_t>(paged.root_row),
            .cluster = paged.root_cluster,
            .bytes = nullptr};
}

void PagePolicy::forget_failures() {
    for (size_t id = 0; id < num_pages(); ++id) {
        PageState failed = PageState::failed;
        states_[id].compare_exchange_strong(failed, PageState::absent);
    }
}

void PagePolicy::touch(uint32_t& last, uint32_t value, Counts& counts) {
    counts.now -= last == noted_ + 1;
    counts.before -= last == noted_;
    counts.now += value == noted_ + 1;
    last = value;
}

// Marks the page in a slot as used by the noted view, and the pages above it as needed.
void PagePolicy::use(int32_t slot, bool is_needed) {
    for (; slot >= 0; slot = uses_[slot].above, is_needed = true) {
        Use& slot_use = uses_[slot];
        if (slot_use.last_needed == noted_ + 1) return;
        touch(slot_use.last_used, noted_ + 1, used_);
        if (is_needed) touch(slot_use.last_needed, noted_ + 1, needed_);
    }
}

// Returns the topmost failed page among this page and the pages above it, or -1 if
// there is none.
int32_t PagePolicy::block_above(int32_t id) const {
    int32_t blocked = -1;
    for (; id >= 0; id = pages_[id].parent)
        if (state_of(id) == PageState::failed) blocked = id;
    return blocked;
}

// Adds an absent page, and the absent pages above it, to the wanted pages. Returns how
// many of these pages the cut misses and have not been counted before.
size_t PagePolicy::ask(const PageRequest& request, bool has_failures) {
    auto id = static_cast<int32_t>(id_of(request.bundle, request.page));
    const int32_t blocked = has_failures ? block_above(id) : -1;
    if (blocked >= 0) id = pages_[blocked].parent;
    float priority = std::min(request.priority, kMostPriority);
    size_t num_missing = 0;
    for (; id >= 0; id = pages_[id].parent, priority *= kAbove) {
        if (slot_of_page_[id] != kNoSlot) {
            use(slot_of_page_[id], true);
            break;
        }
        Page& page = pages_[id];
        const bool is_new = page.stamp != noted_;
        if (!is_new && page.priority >= priority) break;
        num_missing += priority > 1 && (is_new || page.priority <= 1);
        if (is_new && state_of(id) == PageState::absent)
            wanted_.push_back({request.bundle, id - bundles_[request.bundle].first_page, 0});
        page.stamp = noted_;
        page.priority = priority;
        page.stretch = kNoStretch;
    }
    return num_missing;
}

void PagePolicy::note(Span<const PageRequest> needs, size_t num_left_out, bool has_failures) {
    ++noted_;
    needed_ = {0, needed_.now};
    used_ = {0, used_.now};
    missing_ = num_left_out;
    has_none_leaving_ = false;
    wanted_.clear();
    for (size_t i = 0; i < needs.size; ++i) {
        if (i + kAhead < needs.size) {
            const PageRequest& later = needs[i + kAhead];
            __builtin_prefetch(&slot_of_page_[id_of(later.bundle, later.page)]);
        }
        const PageRequest& need = needs[i];
        const int32_t slot = slot_of_page_[id_of(need.bundle, need.page)];
        if (slot != kNoSlot)
            use(slot, need.priority > 1);
        else if (need.priority > 1 || !bundles_[need.bundle].source->is_far())
            missing_ += ask(need, has_failures);
    }
    num_needed_ = needed_.now;
}

// Sorts the wanted pages in the order of the file, and replaces the key of each page by
// the key of its stretch. A stretch never contains both a page and a page below it. The
// stretch of a page is more urgent than the stretches of the pages below it.
void PagePolicy::find_stretches() {
    std::sort(wanted_.begin(), wanted_.end(), [](const Wanted& a, const Wanted& b) {
        return a.bundle != b.bundle ? a.bundle < b.bundle : a.page < b.page;
    });
    key_of_stretch_.clear();
    uint32_t bundle = UINT32_MAX;
    size_t pages_of_stretch = 1;
    size_t number = 0;        // number of the stretch in its bundle
    int32_t least_above = 0;  // smallest index of a page above the pages of the stretch
    for (const Wanted& w : wanted_) {
        const auto id = static_cast<int32_t>(id_of(w.bundle, w.page));
        if (w.bundle != bundle)
            pages_of_stretch = std::max<size_t>(1, kStretchBytes / bundles_[w.bundle].most_bytes);
        const bool is_next =
            w.bundle != bundle || w.page / pages_of_stretch != number || id >= least_above;
        if (is_next) {
            key_of_stretch_.push_back(0);
            bundle = w.bundle;
            number = w.page / pages_of_stretch;
            least_above = INT32_MAX;
        }
        Page& page = pages_[id];
        page.stretch = static_cast<uint32_t>(key_of_stretch_.size() - 1);
        least_above = std::min(least_above, page.parent);
        key_of_stretch_.back() = std::max(key_of_stretch_.back(), w.key);
    }
    // In the file, a page follows the pages below it. So the key of a stretch is final
    // when the loop reaches the first page of the stretch.
    for (Wanted& w : wanted_) {
        const Page& page = pages_[id_of(w.bundle, w.page)];
        const Page& above = pages_[page.parent];
        const uint32_t key = key_of_stretch_[page.stretch];
        if (above.stamp == noted_ && above.stretch != kNoStretch) {
            uint32_t& key_above = key_of_stretch_[above.stretch];
            key_above = std::min(std::max(key_above, key + 1), kNumKeys - 1);
        }
        // Pages that are requested ahead of use come after all pages that the cut
        // misses.
        w.key = w.key < kKeyOfMissed ? std::min(key, kKeyOfMissed - 1) : key;
    }
}

void PagePolicy::choose(size_t under_way, std::vector<PageRequest>& todo) {
    size_t num_missed = 0;
    std::fill(places_of_key_.begin(), places_of_key_.end(), Places{});
    for (Wanted& w : wanted_) {
        const float priority = pages_[id_of(w.bundle, w.page)].priority;
        num_missed += priority > 1;
        w.key = key_of(priority);
    }
    find_stretches();
    for (const Wanted& w : wanted_) ++places_of_key_[w.key].count;
    const size_t unneeded = num_old(needed_), unused = num_old(used_);
    const size_t room = num_missed > unused ? std::min(num_missed, unneeded) : unused;
    const size_t most = std::min(room > under_way ? room - under_way : 0, kMostChosen);
    // The list begins with the least urgent pages. Drop those for which there is no
    // room.
    size_t num_left_out = wanted_.size() > most ? wanted_.size() - most : 0;
    todo.resize(wanted_.size() - num_left_out);
    uint32_t end = 0;
    for (Places& places : places_of_key_) {
        const auto left_out = static_cast<uint32_t>(std::min<size_t>(places.count, num_left_out));
        num_left_out -= left_out;
        places.count -= left_out;
        places.end = end += places.count;
    }
    for (const Wanted& w : wanted_) {
        Places& places = places_of_key_[w.key];
        if (places.count == 0) continue;
        --places.count;
        todo[--places.end] = {w.bundle, w.page, 0};
    }
}

void PagePolicy::evict(uint32_t s, PagesComing& out) {
    const Slot slot = std::exchange(slots_[s], {});
    const uint32_t id = id_of(slot.bundle, slot.page);
    out.changes.push_back({.bundle = static_cast<uint32_t>(slot.bundle),
                           .page = slot.page,
                           .row = kAbsentPage,
                           .cluster = 0,
                           .bytes = nullptr});
    slot_of_page_[id] = kNoSlot;
    states_[id].store(PageState::absent, std::memory_order_release);
    Use& slot_use = uses_[s];
    if (slot_use.above >= 0) --uses_[slot_use.above].num_children;
    touch(slot_use.last_needed, 0, needed_);
    touch(slot_use.last_used, 0, used_);
    free_slots_.push_back(s);
}

// Collects slots whose pages may be evicted. Called if no slot is free.
void PagePolicy::find_leaving() {
    for (uint32_t s = 0; s < slots_.size(); ++s)
        if (may_go(s)) leaving_.push_back({uses_[s].last_used, s});
    if (leaving_.size() > kMostLeaving) {
        std::nth_element(leaving_.begin(), leaving_.begin() + kMostLeaving, leaving_.end());
        leaving_.resize(kMostLeaving);
    }
    std::make_heap(leaving_.begin(), leaving_.end(), std::greater<>());
    has_none_leaving_ = leaving_.empty();
}

// Removes slots from the front of the heap if they were used after they were added to
// it. Returns whether a slot is left that may be evicted.
bool PagePolicy::has_leaving() {
    while (!leaving_.empty()) {
        const Leaving& first = leaving_.front();
        if (uses_[first.slot].last_used == first.last_used && may_go(first.slot)) return true;
        std::pop_heap(leaving_.begin(), leaving_.end(), std::greater<>());
        leaving_.pop_back();
    }
    return false;
}

// Evicts a page if no slot is free. Returns whether a slot is free afterwards.
// `is_missed` tells whether the slot is for a page that the cut misses, or for one that
// is requested ahead of use.
bool PagePolicy::make_room(bool is_missed, PagesComing& out) {
    if (!free_slots_.empty()) return true;
    if (!has_leaving() && !has_none_leaving_) find_leaving();
    if (leaving_.empty() || (!is_missed && !is_old(leaving_.front().last_used))) return false;
    std::pop_heap(leaving_.begin(), leaving_.end(), std::greater<>());
    const uint32_t s = leaving_.back().slot;
    leaving_.pop_back();
    const int32_t above = uses_[s].above;
    evict(s, out);
    if (above >= 0 && may_go(above)) {
        leaving_.push_back({uses_[above].last_used, static_cast<uint32_t>(above)});
        std::push_heap(leaving_.begin(), leaving_.end(), std::greater<>());
    }
    return true;
}

void PagePolicy::occupy(const LoadedPage& loaded, PagesComing& out) {
    const uint32_t s = free_slots_.back(), id = id_of(loaded.bundle, loaded.page);
    free_slots_.pop_back();
    const auto row = static_cast<int64_t>(plan_.first_slot_row + s * plan_.slot_rows);
    const size_t cluster = plan_.first_slot_cluster + s * plan_.slot_clusters;
    slots_[s] = {static_cast<int32_t>(loaded.bundle), loaded.page};
    Use& slot_use = uses_[s];
    touch(slot_use.last_needed, noted_ + 1, needed_);
    touch(slot_use.last_used, noted_ + 1, used_);
    slot_use.above = slot_of_page_[pages_[id].parent];
    slot_use.num_children = 0;
    if (slot_use.above >= 0) ++uses_[slot_use.above].num_children;
    slot_of_page_[id] = static_cast<int32_t>(s);
    states_[id].store(PageState::resident, std::memory_order_release);
    out.changes.push_back({.bundle = loaded.bundle,
                           .page = loaded.page,
                           .row = row,
                           .cluster = cluster,
                           .bytes = loaded.block});
    out.bytes += bundles_[loaded.bundle].source->num_bytes(loaded.page);
}

void PagePolicy::bring(std::vector<LoadedPage>& loaded, size_t most_bytes, PagesComing& out) {
    for (LoadedPage& next : loaded) next.priority = pages_[id_of(next.bundle, next.page)].priority;
    std::sort(loaded.begin(), loaded.end(), [](const LoadedPage& a, const LoadedPage& b) {
        if (a.priority != b.priority) return a.priority > b.priority;
        return a.bundle != b.bundle ? a.bundle < b.bundle
                                    : a.page > b.page;  // pages above others come first
    });
    left_.clear();
    for (const LoadedPage& next : loaded) {
        const Page& page = pages_[id_of(next.bundle, next.page)];
        const PageState above = state_of(page.parent);
        const bool is_above_coming = above == PageState::loading || above == PageState::loaded;
        const size_t size = bundles_[next.bundle].source->num_bytes(next.page);
        const bool is_full = out.bytes > 0 && out.bytes + size > most_bytes;
        if (is_above_coming || is_full) {
            left_.push_back(next);
            out.num_left += !is_above_coming;
            continue;
        }
        const bool is_wanted = page.stamp + 1 >= noted_;
        if (above == PageState::resident && is_wanted && make_room(page.priority > 1, out)) {
            occupy(next, out);
            continue;
        }
        state(next.bundle, next.page).store(PageState::absent, std::memory_order_release);
        out.dropped.push_back(next.block);
    }
    loaded.swap(left_);
}

}  // namespace v3dg
