#include "residency/page_pool.h"

#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <functional>
#include <stdexcept>
#include <thread>
#include <utility>

namespace v3dg {

namespace {

// A page that the last so many views used stays.
constexpr uint32_t kKeptFrames = 1;
// How the tolerance follows the share of the pool that a view needs.
constexpr float kToleranceStep = 1.02f, kToleranceLeap = 1.189207f;
constexpr double kRoomyShare = 0.7;
// A page above one that is asked for is more urgent by so much.
constexpr float kAbove = 2.0f;
constexpr int kTries = 3;
constexpr size_t kMostLeaving = 4096;  // slots that make room before they are looked for again

enum class PageState : uint8_t { absent, loading, loaded, resident, failed };

struct Page {
    int32_t parent = -1;
    int32_t slot = -1;
    uint32_t stamp = 0;  // frame that asked for it last
    float priority = 0;  // then
    int32_t level = 0;
    PageState state = PageState::absent;
};

struct Bundle {
    std::shared_ptr<const PageSource> source;
    std::vector<int64_t> shift;  // [P]
    std::vector<Page> pages;
    int64_t root_row = 0;
};

struct Slot {
    int32_t bundle = -1;
    uint32_t page = 0;
};
// What is looked through in every frame, of all slots: 0 where there is no page.
struct SlotUses {
    std::vector<uint32_t> last_needed, last_used;  // one more than the frame; used: needed, or nearly
    std::vector<uint32_t> num_children;            // that are resident

    void resize(size_t count) {
        for (auto* of_slots : {&last_needed, &last_used, &num_children}) of_slots->resize(count);
    }
};

// A slot that may go, as long as its page was not used again.
struct Leaving {
    uint32_t last_used, slot;

    bool operator<(const Leaving& other) const {
        return last_used != other.last_used ? last_used < other.last_used : slot < other.slot;
    }
    bool operator>(const Leaving& other) const { return other < *this; }
};

struct Loaded {
    uint32_t bundle, page;
    unsigned char* block;
};

}  // namespace

struct PagePool::State {
    PoolLimits limits;
    const pid_t process = getpid();
    std::vector<Bundle> bundles;
    std::vector<Slot> slots;
    SlotUses uses;
    std::vector<uint32_t> free_slots;
    size_t slot_rows = 1, first_slot_row = 0, block_size = 1;
    int max_sh_degree = 0;

    mutable std::mutex busy;
    std::condition_variable to_read, has_read;
    std::shared_ptr<BlockMemory> memory;  // of all blocks
    std::vector<unsigned char*> free_blocks;
    std::vector<PageRequest> todo;  // the most urgent last
    std::vector<Loaded> loaded;
    size_t num_blocks = 0, most_bytes = 0;  // most: of blocks and the coarsest pages
    size_t num_loading = 0, num_threads = 0;
    bool is_over = false;

    std::vector<PageChange> changes;
    std::vector<unsigned char*> taken;  // blocks of those changes
    uint32_t frame = 0, noted = 0;
    size_t needed = 0, missing = 0, failed = 0, pages_in = 0, bytes_in = 0;
    float least_tolerance = 0;
    std::string error;
    bool is_damage = false;
    // A heap, those first that were not used for longest. It lasts from frame to frame: what comes to be old
    // meanwhile is younger than what it has.
    std::vector<Leaving> leaving;

    Page& page(const PageRequest& r) { return bundles[r.bundle].pages[r.page]; }
    Page& page(const Loaded& l) { return bundles[l.bundle].pages[l.page]; }

    void add_bundle(const PagedBundle& given);
    void plan_memory();
    void read_roots();
    void read_pages();
    bool read_next(std::unique_lock<std::mutex>& lock);
    void use(uint32_t bundle, int32_t page, bool is_needed);
    bool is_old(uint32_t last) const { return last + kKeptFrames < noted + 1; }
    size_t num_old(const std::vector<uint32_t>& last) const;
    bool may_go(uint32_t slot) const {
        return is_old(uses.last_needed[slot]) && uses.num_children[slot] == 0;
    }
    void add_leaving(uint32_t slot);
    void find_leaving();
    bool has_leaving();
    int32_t block_above(const PageRequest& r) const;
    size_t ask(PageRequest r, std::vector<PageRequest>& wanted);
    void choose_pages(std::vector<PageRequest>& wanted);
    void adapt_tolerance(float tolerance_px2);
    void evict(uint32_t slot);
    bool make_room(bool is_missed);
    void bring(const Loaded& next, uint32_t slot);
    void bring_loaded(bool is_bounded);
    // A thread that another process has may hold the lock for ever in this one.
    std::unique_lock<std::mutex> locked() const {
        if (getpid() != process)
            throw std::runtime_error(
                "memory: expected a renderer of this process, got one from before a fork; make another");
        return std::unique_lock<std::mutex>(busy);
    }
};

void PagePool::State::add_bundle(const PagedBundle& given) {
    const ClusterTable& table = given.table;
    Bundle bundle;
    bundle.source = given.source;
    const size_t num_pages = table.num_pages(), root = num_pages - 1;
    bundle.pages.resize(num_pages);
    bundle.shift.assign(num_pages, kAbsentPage);
    for (size_t g = 0; g < root; ++g) bundle.pages[g].level = table.level[g];
    bundle.pages[root].level = INT32_MAX;
    for (size_t c = 0; c < table.num_clusters(); ++c) {
        if (table.own_group[c] >= 0)
            bundle.pages[table.own_group[c]].parent = static_cast<int32_t>(table.page_of(c));
    }
    max_sh_degree = std::max(max_sh_degree, given.source->sh_degree());
    bundles.push_back(std::move(bundle));
}

void PagePool::State::plan_memory() {
    size_t root_rows = 0, num_pages = 0;
    for (Bundle& bundle : bundles) {
        const size_t root = bundle.pages.size() - 1;
        bundle.root_row = static_cast<int64_t>(root_rows);
        root_rows += bundle.source->num_rows(root);
        num_pages += root;
        for (size_t p = 0; p < root; ++p) {
            slot_rows = std::max(slot_rows, bundle.source->num_rows(p));
            block_size = std::max(block_size, bundle.source->num_bytes(p));
        }
    }
    first_slot_row = root_rows;
    const size_t least = root_rows + (num_pages > 0 ? bundles.size() * slot_rows : 0);
    if (limits.num_rows < least)
        throw std::invalid_argument("memory: expected room for at least " + std::to_string(least) +
                                    " gaussians, the coarsest of all bundles and a page more of each, got "
                                    "room for " +
                                    std::to_string(limits.num_rows));
    slots.resize(std::min((limits.num_rows - root_rows) / slot_rows, num_pages));
    uses.resize(slots.size());
    for (size_t s = slots.size(); s > 0; --s) free_slots.push_back(static_cast<uint32_t>(s - 1));
}

void PagePool::State::read_roots() {
    for (uint32_t b = 0; b < bundles.size(); ++b) {
        Bundle& bundle = bundles[b];
        const auto root = static_cast<uint32_t>(bundle.pages.size() - 1);
        if (bundle.source->num_clusters() == 0) continue;
        unsigned char* bytes = memory->allocate((bundle.source->num_bytes(root) + 15) / 16 * 16);
        most_bytes += (bundle.source->num_bytes(root) + 15) / 16 * 16;
        bundle.source->read(root, bytes);
        bundle.pages[root].state = PageState::resident;
        bundle.shift[root] = bundle.root_row - bundle.source->first_row(root);
        changes.push_back({b, root, bundle.root_row, bytes});
    }
}

// A page is read, and is then either loaded or failed. Returns whether there was one to read.
bool PagePool::State::read_next(std::unique_lock<std::mutex>& lock) {
    while (!todo.empty() && page(todo.back()).state != PageState::absent) todo.pop_back();
    if (todo.empty() || free_blocks.empty()) return false;
    const PageRequest next = todo.back();
    todo.pop_back();
    unsigned char* block = free_blocks.back();
    free_blocks.pop_back();
    page(next).state = PageState::loading;
    ++num_loading;
    const std::shared_ptr<const PageSource> source = bundles[next.bundle].source;
    std::string problem;
    bool is_damaged = false, is_read = false;
    lock.unlock();
    for (int tried = 0; tried < kTries && !is_read; ++tried) {
        if (tried > 0) std::this_thread::sleep_for(std::chrono::milliseconds(tried == 1 ? 5 : 50));
        try {
            source->read(next.page, block);
            is_read = true;
        } catch (const PageError& caught) {
            problem = caught.what();
            is_damaged = caught.is_damage;
        }
    }
    lock.lock();
    --num_loading;
    if (is_read) {
        page(next).state = PageState::loaded;
        loaded.push_back({next.bundle, next.page, block});
    } else {
        page(next).state = PageState::failed;
        free_blocks.push_back(block);
        ++failed;
        error = problem;
        is_damage = is_damaged;
    }
    has_read.notify_all();
    return true;
}

void PagePool::State::read_pages() {
    std::unique_lock<std::mutex> lock(busy);
    while (!is_over) {
        if (read_next(lock)) continue;
        has_read.notify_all();
        to_read.wait(lock);
    }
    --num_threads;
    has_read.notify_all();
}

// Marks a resident page as used in the noted frame, and those above it as needed.
void PagePool::State::use(uint32_t b, int32_t p, bool is_needed) {
    for (; p >= 0; p = bundles[b].pages[p].parent, is_needed = true) {
        const Page& page = bundles[b].pages[p];
        if (page.slot < 0) return;  // the root
        if (uses.last_needed[page.slot] == noted + 1) return;
        uses.last_used[page.slot] = noted + 1;
        if (is_needed) uses.last_needed[page.slot] = noted + 1;
    }
}

// Slots without a page that was needed, or used, lately: free ones, too.
size_t PagePool::State::num_old(const std::vector<uint32_t>& last) const {
    return std::count_if(last.begin(), last.end(), [this](uint32_t frame) { return is_old(frame); });
}

// A page that cannot be had, itself or above a page; -1: none.
int32_t PagePool::State::block_above(const PageRequest& r) const {
    const std::vector<Page>& pages = bundles[r.bundle].pages;
    for (int32_t p = static_cast<int32_t>(r.page); p >= 0 && failed > 0; p = pages[p].parent)
        if (pages[p].state == PageState::failed) return p;
    return -1;
}

// Adds an absent page and those above it to what is wanted. Returns how many of them the cut misses that it
// was not known to miss.
size_t PagePool::State::ask(PageRequest r, std::vector<PageRequest>& wanted) {
    std::vector<Page>& pages = bundles[r.bundle].pages;
    const int32_t blocked = block_above(r);
    size_t num_missing = 0;
    for (int32_t p = blocked >= 0 ? pages[blocked].parent : static_cast<int32_t>(r.page); p >= 0;
         p = pages[p].parent, r.priority *= kAbove) {
        Page& page = pages[p];
        if (page.state == PageState::resident) {
            use(r.bundle, p, true);
            break;
        }
        const bool is_new = page.stamp != noted;
        if (!is_new && page.priority >= r.priority) break;
        num_missing += r.priority > 1 && (is_new || page.priority <= 1);
        if (is_new && page.state == PageState::absent)
            wanted.push_back({r.bundle, static_cast<uint32_t>(p), 0});
        page.stamp = noted;
        page.priority = r.priority;
    }
    return num_missing;
}

// From all pages that are wanted those that are read next: no more than there will be room for.
void PagePool::State::choose_pages(std::vector<PageRequest>& wanted) {
    const size_t unneeded = num_old(uses.last_needed), unused = num_old(uses.last_used);
    const size_t num_missed =
        std::count_if(wanted.begin(), wanted.end(), [](const PageRequest& r) { return r.priority > 1; });
    const size_t room = num_missed > unused ? std::min(num_missed, unneeded) : unused;
    const size_t under_way = num_loading + loaded.size();
    const size_t most = std::min(room > under_way ? room - under_way : 0, size_t(1) << 14);
    const auto is_less_urgent = [&](const PageRequest& a, const PageRequest& b) {
        if (a.priority != b.priority) return a.priority < b.priority;
        if (page(a).level != page(b).level) return page(a).level < page(b).level;
        return a.bundle != b.bundle ? a.bundle > b.bundle : a.page > b.page;
    };
    if (wanted.size() > most) {
        const auto cut = wanted.end() - static_cast<std::ptrdiff_t>(most);
        std::nth_element(wanted.begin(), cut, wanted.end(), is_less_urgent);
        wanted.erase(wanted.begin(), cut);
    }
    std::sort(wanted.begin(), wanted.end(), is_less_urgent);
    todo.swap(wanted);
    to_read.notify_all();
}

void PagePool::State::adapt_tolerance(float tolerance_px2) {
    if (needed > slots.size())
        least_tolerance = std::max(least_tolerance, tolerance_px2) * kToleranceStep;
    else if (static_cast<double>(needed) < kRoomyShare * static_cast<double>(slots.size()))
        least_tolerance = least_tolerance < tolerance_px2 ? 0 : least_tolerance / kToleranceStep;
}

void PagePool::State::evict(uint32_t s) {
    Slot& slot = slots[s];
    Bundle& bundle = bundles[slot.bundle];
    Page& page = bundle.pages[slot.page];
    changes.push_back({static_cast<uint32_t>(slot.bundle), slot.page, kAbsentPage, nullptr});
    bundle.shift[slot.page] = kAbsentPage;
    page.state = PageState::absent;
    page.slot = -1;
    const int32_t above = bundle.pages[page.parent].slot;
    if (above >= 0) --uses.num_children[above];
    slot = {};
    uses.last_needed[s] = uses.last_used[s] = 0;
    free_slots.push_back(s);
}

void PagePool::State::add_leaving(uint32_t s) {
    leaving.push_back({uses.last_used[s], s});
    std::push_heap(leaving.begin(), leaving.end(), std::greater<>());
}

// Where no slot is free.
void PagePool::State::find_leaving() {
    for (uint32_t s = 0; s < slots.size(); ++s)
        if (may_go(s)) leaving.push_back({uses.last_used[s], s});
    if (leaving.size() > kMostLeaving) {
        std::nth_element(leaving.begin(), leaving.begin() + kMostLeaving, leaving.end());
        leaving.resize(kMostLeaving);
    }
    std::make_heap(leaving.begin(), leaving.end(), std::greater<>());
}

// Whether the first of the heap may go; those that were used again are dropped.
bool PagePool::State::has_leaving() {
    while (!leaving.empty()) {
        const Leaving& first = leaving.front();
        if (uses.last_used[first.slot] == first.last_used && may_go(first.slot)) return true;
        std::pop_heap(leaving.begin(), leaving.end(), std::greater<>());
        leaving.pop_back();
    }
    return false;
}

// Sees to it that there is a free slot, for a page that the cut misses or one that it nearly does.
bool PagePool::State::make_room(bool is_missed) {
    if (!free_slots.empty()) return true;
    if (!has_leaving()) find_leaving();
    if (leaving.empty() || (!is_missed && !is_old(leaving.front().last_used))) return false;
    std::pop_heap(leaving.begin(), leaving.end(), std::greater<>());
    const uint32_t s = leaving.back().slot;
    leaving.pop_back();
    const Bundle& bundle = bundles[slots[s].bundle];
    const int32_t above = bundle.pages[bundle.pages[slots[s].page].parent].slot;
    evict(s);
    if (above >= 0 && may_go(above)) add_leaving(above);
    return true;
}

void PagePool::State::bring(const Loaded& next, uint32_t s) {
    Bundle& bundle = bundles[next.bundle];
    Page& page = bundle.pages[next.page];
    const auto row = static_cast<int64_t>(first_slot_row + s * slot_rows);
    slots[s] = {static_cast<int32_t>(next.bundle), next.page};
    uses.last_needed[s] = uses.last_used[s] = frame + 1;
    uses.num_children[s] = 0;
    page.slot = static_cast<int32_t>(s);
    page.state = PageState::resident;
    const int32_t above = bundle.pages[page.parent].slot;
    if (above >= 0) ++uses.num_children[above];
    bundle.shift[next.page] = row - bundle.source->first_row(next.page);
    changes.push_back({next.bundle, next.page, row, next.block});
    taken.push_back(next.block);
    ++pages_in;
    bytes_in += bundle.source->num_bytes(next.page);
}

// Pages above others come first; what the frame has no bytes left for stays loaded.
void PagePool::State::bring_loaded(bool is_bounded) {
    std::sort(loaded.begin(), loaded.end(), [&](const Loaded& a, const Loaded& b) {
        const Page &x = page(a), &y = page(b);
        if (x.level != y.level) return x.level > y.level;
        if (x.priority != y.priority) return x.priority > y.priority;
        return a.bundle != b.bundle ? a.bundle < b.bundle : a.page < b.page;
    });
    size_t bytes = 0;
    std::vector<Loaded> left;
    for (const Loaded& next : loaded) {
        const PageState above = bundles[next.bundle].pages[page(next).parent].state;
        const size_t size = bundles[next.bundle].source->num_bytes(next.page);
        const bool is_above_coming = above == PageState::loading || above == PageState::loaded;
        if (is_above_coming || (is_bounded && bytes > 0 && bytes + size > limits.most_bytes_a_frame)) {
            left.push_back(next);
            continue;
        }
        const bool is_wanted = page(next).stamp + kKeptFrames >= noted;
        if (above != PageState::resident || !is_wanted || !make_room(page(next).priority > 1)) {
            page(next).state = PageState::absent;
            free_blocks.push_back(next.block);
            continue;
        }
        const uint32_t s = free_slots.back();
        free_slots.pop_back();
        bring(next, s);
        bytes += size;
    }
    loaded.swap(left);
}

PagePool::PagePool(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
                   std::shared_ptr<BlockMemory> memory)
    : state_(std::make_shared<State>()) {
    State& state = *state_;
    state.limits = limits;
    for (const PagedBundle& bundle : bundles) state.add_bundle(bundle);
    state.plan_memory();
    state.memory = std::move(memory);
    state.read_roots();
    const size_t size = (state.block_size + 4095) / 4096 * 4096;
    const size_t num_blocks =
        std::clamp<size_t>(limits.block_bytes / size, std::min<size_t>(4, state.slots.size()),
                           std::max<size_t>(state.slots.size(), 1));
    state.num_blocks = num_blocks;
    state.most_bytes += num_blocks * size;
    unsigned char* blocks = state.memory->allocate(num_blocks * size);
    for (size_t k = 0; k < num_blocks; ++k) state.free_blocks.push_back(blocks + k * size);
    state.missing = state.slots.empty() ? 0 : 1;  // until it is known
    state.num_threads = state.slots.empty() ? 0 : limits.num_threads;
    for (size_t t = 0; t < state.num_threads; ++t)
        std::thread([shared = state_] { shared->read_pages(); }).detach();
}

// A thread that a disk never answers is left behind, with what it writes to. So is all in a child of fork(),
// whose copy of the threads' locks can never be destroyed.
PagePool::~PagePool() {
    State& state = *state_;
    if (getpid() != state.process) {
        static_cast<void>(new std::shared_ptr<State>(state_));
        return;
    }
    std::unique_lock<std::mutex> lock(state.busy);
    state.is_over = true;
    state.to_read.notify_all();
    state.has_read.wait_for(lock, std::chrono::seconds(2), [&] { return state.num_threads == 0; });
}

size_t PagePool::num_bundles() const { return state_->bundles.size(); }
size_t PagePool::slot_rows() const { return state_->slot_rows; }
size_t PagePool::first_slot_row() const { return state_->first_slot_row; }
size_t PagePool::num_slots() const { return state_->slots.size(); }
int PagePool::max_sh_degree() const { return state_->max_sh_degree; }
uint32_t PagePool::frame() const { return state_->frame; }
Span<const int64_t> PagePool::shift(size_t b) const {
    const std::vector<int64_t>& shift = state_->bundles[b].shift;
    return {shift.data(), shift.size()};
}
const PageSource& PagePool::source(uint32_t b) const { return *state_->bundles[b].source; }
size_t PagePool::most_changes() const { return 2 * state_->num_blocks + state_->bundles.size(); }
size_t PagePool::most_needs() const {
    size_t num_pages = 0;
    for (const Bundle& bundle : state_->bundles) num_pages += bundle.pages.size();
    // A page has two clusters, unless groups are larger, and each may ask for another page.
    return std::min(num_pages, 8 * state_->slots.size() + 1024);
}
size_t PagePool::most_bytes_on_their_way() const { return state_->most_bytes; }

const std::vector<PageChange>& PagePool::begin_frame(bool is_bounded) {
    State& state = *state_;
    const auto lock = state.locked();
    if (++state.frame > 1) state.changes.clear();
    state.bring_loaded(is_bounded);
    return state.changes;
}

std::vector<unsigned char*> PagePool::take_blocks() {
    const auto lock = state_->locked();
    return std::exchange(state_->taken, {});
}

void PagePool::give_back(const std::vector<unsigned char*>& blocks) {
    const auto lock = state_->locked();
    state_->free_blocks.insert(state_->free_blocks.end(), blocks.begin(), blocks.end());
    state_->to_read.notify_all();
}

void PagePool::release() { give_back(take_blocks()); }

void PagePool::note_needs(uint32_t frame, Span<const PageRequest> needs, size_t num_left_out,
                          float tolerance_px2, bool adapts) {
    State& state = *state_;
    const auto lock = state.locked();
    state.noted = frame;
    std::vector<PageRequest> wanted;
    state.missing = num_left_out;
    for (const PageRequest& r : needs) {
        if (state.page(r).state == PageState::resident)
            state.use(r.bundle, static_cast<int32_t>(r.page), r.priority > 1);
        else
            state.missing += state.ask(r, wanted);
    }
    for (PageRequest& r : wanted) r.priority = state.page(r).priority;
    state.needed = state.missing;
    const std::vector<uint32_t>& needed = state.uses.last_needed;
    state.needed += std::count(needed.begin(), needed.end(), frame + 1);
    state.choose_pages(wanted);
    if (adapts) state.adapt_tolerance(tolerance_px2);
}

bool PagePool::raise_tolerance_at_once(float tolerance_px2) {
    const auto lock = state_->locked();
    if (state_->needed <= state_->slots.size()) return false;
    state_->least_tolerance = std::max(tolerance_px2, 1e-6f) * kToleranceLeap;
    return true;
}

void PagePool::reset_tolerance() {
    const auto lock = state_->locked();
    state_->least_tolerance = 0;
}

bool PagePool::wait(double seconds) {
    State& state = *state_;
    auto lock = state.locked();
    state.has_read.wait_for(lock, std::chrono::duration<double>(seconds), [&] {
        return state.free_blocks.empty() || (state.todo.empty() && state.num_loading == 0);
    });
    return !state.loaded.empty();
}

bool PagePool::read_one() {
    auto lock = state_->locked();
    return state_->read_next(lock);
}

void PagePool::forget_failures() {
    State& state = *state_;
    const auto lock = state.locked();
    if (state.failed == 0) return;
    for (Bundle& bundle : state.bundles)
        for (Page& page : bundle.pages)
            if (page.state == PageState::failed) page.state = PageState::absent;
    state.failed = 0;
    state.error.clear();
}

PoolStatus PagePool::status() const {
    const State& state = *state_;
    const auto lock = state.locked();
    return {state.slots.size(), state.slots.size() - state.free_slots.size(),
            state.needed,       state.missing,
            state.failed,       state.pages_in,
            state.bytes_in,     state.least_tolerance,
            state.error,        state.is_damage};
}

}  // namespace v3dg
