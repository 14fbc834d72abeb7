#include "residency/page_pool.h"

#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <new>
#include <stdexcept>
#include <thread>
#include <utility>

#include "base/parallel_for.h"

namespace v3dg {

namespace {

// How the tolerance follows the share of the pool that a view needs.
constexpr float kToleranceStep = 1.02f, kToleranceLeap = 1.189207f;
constexpr double kRoomyShare = 0.7;
constexpr int kTries = 3;
constexpr size_t kMostAtOnce = 64;  // pages that a thread asks the disk for together
constexpr size_t kMostBytesTogether = size_t(512)
                                      << 10;  // of those, that it then reads and hashes together
constexpr size_t kSamples = 1 << 14;          // of the sizes of pages
constexpr int kSpins = 64;  // before a frame does without what another thread holds

// A page that a thread reads.
struct Reading {
    PageRequest page;
    unsigned char* block;
};

}  // namespace

struct PagePool::State {
    State(const std::vector<PagedBundle>& bundles, const PoolLimits& given)
        : limits(given), policy(bundles, given.memory), arrivals(policy) {
        decides_itself = limits.num_threads == 0 || policy.num_slots() == 0;
        missing = policy.num_slots() == 0 ? 0 : 1;  // until it is known
    }

    const PoolLimits limits;
    std::atomic<size_t> most_bytes_a_frame{limits.most_bytes_a_frame};
    const pid_t process = getpid();
    int max_sh_degree = 0;
    size_t most_needs = 0, most_bytes = 0;  // most_bytes: of blocks and the coarsest pages
    bool decides_itself = false;            // in the threads that call
    std::shared_ptr<BlockMemory> memory;
    std::vector<FrameNeeds> all_needs;

    // Of who decides, a thread at a time.
    PagePolicy policy;
    std::vector<LoadedPage> loaded;
    PagesComing coming;
    std::vector<PageRequest> chosen;

    // Under the lock.
    mutable std::mutex busy;
    std::condition_variable to_decide, to_read, has_changed;
    PageBlocks blocks;
    std::vector<PageRequest> todo;  // the most urgent last
    std::vector<LoadedPage> read;   // and not seen by who decides
    std::vector<PageChange> ready;  // for the next frame
    size_t ready_bytes = 0, num_left = 0, num_loading = 0, num_threads = 0;
    FrameNeeds* noted = nullptr;  // not decided about
    uint64_t decided_view = 0;    // the last view that was decided about
    std::vector<FrameNeeds*> free_needs;
    uint64_t rounds_begun = 0, rounds_over = 0;  // of deciding
    bool wants_round = false, takes_all = false, lacks_blocks = false, is_over = false;
    bool frees_readers = false;  // who decides wakes them, for that takes a frame too long
    bool has_noted = false;      // since a frame took what is ready
    std::string error;
    bool is_damage = false;

    // Read by all.
    std::atomic<size_t> needed{0}, missing{0}, failed{0}, num_resident{0}, pages_in{0}, bytes_in{0};
    std::atomic<float> least_tolerance{0};

    // Of frames.
    bool has_begun = false, has_looked = false;  // has_looked: the frame before was not bounded
    float least_of_frame = 0;
    std::vector<PageChange> changes;
    std::vector<unsigned char*> taken,
        returned;                             // blocks of those changes; blocks to be used again
    std::vector<std::vector<int64_t>> shift;  // [P] of each bundle
    PageArrivals arrivals;
    std::vector<FrameNeeds*> idle_needs;
    FrameNeeds* to_note = nullptr;
    uint64_t views = 0;  // that were noted

    void read_roots(size_t num_bundles);
    void allocate(size_t num_bundles);
    void start_threads(const std::shared_ptr<State>& shared);
    void stop_threads();

    bool may_note() const;
    bool has_to_decide() const;
    bool is_deciding() const { return rounds_begun != rounds_over; }
    void decide(std::unique_lock<std::mutex>& lock);
    void adapt_tolerance(const FrameNeeds& of);
    void decide_next_round(std::unique_lock<std::mutex>& lock);
    void decide_always();

    bool read_some(std::unique_lock<std::mutex>& lock, size_t most);
    void read_batch(Reading* batch, size_t count, std::unique_lock<std::mutex>& lock);
    void read_together(uint32_t bundle, Span<PageReading> pages,
                       std::unique_lock<std::mutex>& lock);
    void finish(uint32_t bundle, const PageReading& of);
    void read_always();

    void exchange();
    void forget_noted();
    void forget_failures();
    size_t count_absent(const FrameNeeds& needs) const;
    void take_changes(bool is_bounded);
    void take_ready();

    // A thread that another process has may hold the lock for ever in this one.
    void check_process() const {
        if (getpid() != process)
            throw std::runtime_error(
                "memory: expected a renderer of this process, got one from before a fork; make "
                "another");
    }
    std::unique_lock<std::mutex> locked() const {
        check_process();
        return std::unique_lock<std::mutex>(busy);
    }
    // Without waiting for who holds it.
    std::unique_lock<std::mutex> locked_at_once() const {
        check_process();
        std::unique_lock<std::mutex> lock(busy, std::try_to_lock);
        for (int k = 0; k < kSpins && !lock.owns_lock(); ++k) static_cast<void>(lock.try_lock());
        return lock;
    }
};

void PagePool::State::read_roots(size_t num_bundles) {
    std::vector<size_t> first{0};
    for (uint32_t b = 0; b < num_bundles; ++b) {
        const PageSource& source = policy.source(b);
        const size_t root = source.num_pages() - 1;
        max_sh_degree = std::max(max_sh_degree, source.sh_degree());
        first.push_back(first.back());
        if (source.num_clusters() == 0) continue;
        changes.push_back(policy.root(b));
        first.back() += (source.num_bytes(root) + 15) / 16 * 16;
    }
    most_bytes = first.back();
    unsigned char* bytes = memory->allocate(std::max<size_t>(most_bytes, 1));
    for (PageChange& change : changes) change.bytes = bytes + first[change.bundle];
    shift.resize(num_bundles);
    parallel_for(num_bundles, 1,
                 [&](size_t b) { shift[b].assign(policy.source(b).num_pages(), kAbsentPage); });
    parallel_for(changes.size(), 1, [&](size_t k) {
        const PageChange& change = changes[k];
        const PageSource& source = policy.source(change.bundle);
        source.read(change.page, bytes + first[change.bundle]);
        shift[change.bundle][change.page] = change.row - source.first_row(change.page);
    });
}

// All that threads write to, so that they never want for memory.
void PagePool::State::allocate(size_t num_bundles) {
    std::vector<size_t> samples;
    const size_t step = policy.num_pages() / kSamples + 1;
    for (size_t b = 0; b < num_bundles; ++b) {
        const PageSource& source = policy.source(b);
        for (size_t p = b % step; p + 1 < source.num_pages(); p += step)
            samples.push_back(source.num_bytes(p));
    }
    blocks.allocate(samples, policy.most_page_bytes(), limits.block_bytes, policy.num_slots(),
                    *memory);
    most_bytes += blocks.num_bytes();
    const size_t count = blocks.num_blocks();
    policy.reserve(count);
    for (auto* pages : {&loaded, &read}) pages->reserve(count);
    for (auto* of_blocks : {&coming.dropped, &taken, &returned}) of_blocks->reserve(count);
    for (auto* of_changes : {&coming.changes, &ready, &changes})
        of_changes->reserve(2 * count + num_bundles);
    // A page has two clusters, unless groups are larger, and each may ask for another page.
    most_needs = std::min(policy.num_pages(), 8 * policy.num_slots() + 1024);
    all_needs.resize(limits.most_frames + 2);  // and those that wait, and are decided about
    for (FrameNeeds& needs : all_needs) {
        needs.list =
            reinterpret_cast<PageRequest*>(memory->allocate(most_needs * sizeof(PageRequest)));
        idle_needs.push_back(&needs);
    }
    free_needs.reserve(all_needs.size());
}

void PagePool::State::start_threads(const std::shared_ptr<State>& shared) {
    if (decides_itself) return;
    try {
        for (unsigned t = 0; t <= limits.num_threads; ++t) {
            const std::unique_lock<std::mutex> lock(busy);
            std::thread([shared, t] {
                t == 0 ? shared->decide_always() : shared->read_always();
            }).detach();
            ++num_threads;
        }
    } catch (...) {
        stop_threads();
        throw;
    }
}

void PagePool::State::stop_threads() {
    std::unique_lock<std::mutex> lock(busy);
    is_over = true;
    to_decide.notify_all();
    to_read.notify_all();
    has_changed.wait_for(lock, std::chrono::seconds(2), [&] { return num_threads == 0; });
}

// Under the lock, as all from here to who reads. What is ready for a frame was needed by the last
// view or the one before, and so is not to leave before that frame has it: changes that are taken
// together bring at most one page to a slot.
bool PagePool::State::may_note() const { return noted != nullptr && (!has_noted || ready.empty()); }

bool PagePool::State::has_to_decide() const {
    return wants_round || may_note() || frees_readers ||
           ((num_left > 0 || !read.empty()) && ready_bytes < most_bytes_a_frame);
}

// Decides without the lock about what is there; what threads and frames do meanwhile is seen the
// next time.
void PagePool::State::decide(std::unique_lock<std::mutex>& lock) {
    ++rounds_begun;
    wants_round = false;
    if (std::exchange(frees_readers, false)) to_read.notify_all();
    FrameNeeds* needs = may_note() ? std::exchange(noted, nullptr) : nullptr;
    has_noted |= needs != nullptr;
    loaded.insert(loaded.end(), read.begin(), read.end());
    read.clear();
    const size_t under_way = num_loading + loaded.size();
    const size_t most_bytes_ready = takes_all ? SIZE_MAX : most_bytes_a_frame.load();
    const size_t bytes_left = most_bytes_ready - std::min(most_bytes_ready, ready_bytes);
    lock.unlock();

    bool is_known = needs != nullptr;
    try {
        if (needs != nullptr) {
            policy.note({needs->list, needs->count}, needs->num_left_out, failed > 0);
            policy.choose(under_way, chosen);
        }
    } catch (const std::bad_alloc&) {
        is_known = false;  // the next frame tells again
    }
    coming.clear();
    if (bytes_left > 0)
        policy.bring(loaded, bytes_left, coming);
    else
        coming.num_left = loaded.size();

    lock.lock();
    if (is_known) {
        todo.swap(chosen);
        decided_view = needs->view;
        needed = policy.needed();
        missing = policy.missing();
        if (needs->adapts) adapt_tolerance(*needs);
    }
    if (needs != nullptr) free_needs.push_back(needs);
    for (unsigned char* block : coming.dropped) blocks.give_back(block);
    ready.insert(ready.end(), coming.changes.begin(), coming.changes.end());
    ready_bytes += coming.bytes;
    num_left = coming.num_left;
    if (is_known || !coming.dropped.empty()) to_read.notify_all();
    ++rounds_over;
    has_changed.notify_all();
}

// From what the frame was drawn with, so that it makes one step for all frames that were under way
// meanwhile.
void PagePool::State::adapt_tolerance(const FrameNeeds& of) {
    const size_t slots = policy.num_slots();
    const float least = least_tolerance;
    const bool is_roomy = static_cast<double>(needed) < kRoomyShare * static_cast<double>(slots);
    if (needed > slots)
        least_tolerance = std::max(least, of.tolerance_px2 * kToleranceStep);
    else if (is_roomy && of.least_px2 >= of.tolerance_px2)
        least_tolerance = std::min(least, of.least_px2 / kToleranceStep);
    else if (is_roomy && of.least_px2 == least)
        least_tolerance = 0;
}

// Waits until all is decided about that is there now.
void PagePool::State::decide_next_round(std::unique_lock<std::mutex>& lock) {
    if (decides_itself) return decide(lock);
    const uint64_t next = rounds_begun + 1;
    wants_round = true;
    to_decide.notify_one();
    has_changed.wait(lock, [&] { return rounds_over >= next; });
}

void PagePool::State::decide_always() {
    std::unique_lock<std::mutex> lock(busy);
    while (!is_over) {
        if (has_to_decide())
            decide(lock);
        else
            to_decide.wait(lock);
    }
    --num_threads;
    has_changed.notify_all();
}

// Reads some of the most urgent pages. Returns whether there was one, and a block for it.
bool PagePool::State::read_some(std::unique_lock<std::mutex>& lock, size_t most) {
    Reading batch[kMostAtOnce];
    size_t count = 0;
    while (count < most && !todo.empty()) {
        const PageRequest next = todo.back();
        std::atomic<PageState>& state = policy.state(next.bundle, next.page);
        if (state == PageState::absent) {
            unsigned char* block = blocks.take(policy.source(next.bundle).num_bytes(next.page));
            if (block == nullptr) {
                lacks_blocks = true;
                break;
            }
            state = PageState::loading;
            batch[count++] = {next, block};
        }
        todo.pop_back();
    }
    num_loading += count;
    if (count == 0) return false;
    lock.unlock();
    read_batch(batch, count, lock);
    lock.lock();
    return true;
}

// Without the lock: has all read in the order of files, a few together, the disk begins with all at
// once.
void PagePool::State::read_batch(Reading* batch, size_t count, std::unique_lock<std::mutex>& lock) {
    std::sort(batch, batch + count, [](const Reading& a, const Reading& b) {
        return a.page.bundle != b.page.bundle ? a.page.bundle < b.page.bundle
                                              : a.page.page < b.page.page;
    });
    PageReading pages[kMostAtOnce];
    for (size_t k = 0; k < count; ++k) {
        pages[k].page = batch[k].page.page;
        pages[k].bytes = batch[k].block;
    }
    // Calls visit(bundle, pages of it) for so many bytes.
    const auto for_each = [&](size_t most_bytes, const auto& visit) {
        for (size_t first = 0, end = 0; first < count; first = end) {
            const uint32_t bundle = batch[first].page.bundle;
            for (size_t bytes = 0; end < count && batch[end].page.bundle == bundle; ++end) {
                bytes += policy.source(bundle).num_bytes(pages[end].page);
                if (end > first && bytes > most_bytes) break;
            }
            visit(bundle, Span<PageReading>{pages + first, end - first});
        }
    };
    if (count > 1) for_each(SIZE_MAX, [&](uint32_t b, auto of) { policy.source(b).expect(of); });
    for_each(kMostBytesTogether, [&](uint32_t b, auto of) { read_together(b, of, lock); });
}

// Without the lock: has pages of a bundle read. Those that are there are loaded at once, others
// tried again.
void PagePool::State::read_together(uint32_t bundle, Span<PageReading> pages,
                                    std::unique_lock<std::mutex>& lock) {
    policy.source(bundle).read_pages(pages);
    lock.lock();
    for (const PageReading& of : pages)
        if (!of.error) finish(bundle, of);
    lock.unlock();
    for (PageReading& of : pages) {
        if (!of.error) continue;
        for (int tried = 1; tried < kTries && of.error; ++tried) {
            std::this_thread::sleep_for(std::chrono::milliseconds(tried == 1 ? 5 : 50));
            of.error.reset();
            policy.source(bundle).read_pages({&of, 1});
        }
        lock.lock();
        finish(bundle, of);
        lock.unlock();
    }
}

// Under the lock: a page is loaded, or has failed.
void PagePool::State::finish(uint32_t bundle, const PageReading& of) {
    --num_loading;
    policy.state(bundle, of.page) = of.error ? PageState::failed : PageState::loaded;
    if (!of.error) {
        read.push_back({bundle, static_cast<uint32_t>(of.page), of.bytes});
        if (has_to_decide()) to_decide.notify_one();
    } else {
        blocks.give_back(of.bytes);
        ++failed;
        error = of.error->what();
        is_damage = of.error->is_damage;
    }
    has_changed.notify_all();
}

void PagePool::State::read_always() {
    std::unique_lock<std::mutex> lock(busy);
    while (!is_over) {
        // A few, so that the other threads have as much to do.
        const size_t share = todo.size() / (2 * size_t(limits.num_threads));
        if (read_some(lock, std::clamp<size_t>(share, 1, kMostAtOnce))) continue;
        has_changed.notify_all();
        to_read.wait(lock);
    }
    --num_threads;
    has_changed.notify_all();
}

// Under the lock: what frames have for others, and what they get back.
void PagePool::State::exchange() {
    if (to_note != nullptr) {
        if (noted != nullptr) idle_needs.push_back(noted);
        noted = std::exchange(to_note, nullptr);
    }
    idle_needs.insert(idle_needs.end(), free_needs.begin(), free_needs.end());
    free_needs.clear();
    for (unsigned char* block : returned) blocks.give_back(block);
    if (!returned.empty() && lacks_blocks) {
        lacks_blocks = false;
        frees_readers = true;
    }
    returned.clear();
    if (has_to_decide()) to_decide.notify_one();
}

// Requires the lock. A view that was noted and not decided about is decided about no more.
void PagePool::State::forget_noted() {
    if (noted != nullptr) idle_needs.push_back(std::exchange(noted, nullptr));
}

// Requires the lock.
void PagePool::State::forget_failures() {
    if (failed.exchange(0) == 0) return;
    policy.forget_failures();
    error.clear();
}

// The pages that the cut of the frame that began last missed.
size_t PagePool::State::count_absent(const FrameNeeds& needs) const {
    size_t count = needs.num_left_out;
    for (size_t k = 0; k < needs.count; ++k) {
        const PageRequest& need = needs.list[k];
        count += need.priority > 1 && shift[need.bundle][need.page] == kAbsentPage;
    }
    return count;
}

// Without the lock: takes note of the changes.
void PagePool::State::take_ready() {
    for (const PageChange& change : changes) {
        const PageSource& source = policy.source(change.bundle);
        if (change.bytes == nullptr) {
            shift[change.bundle][change.page] = kAbsentPage;
            --num_resident;
            continue;
        }
        shift[change.bundle][change.page] = change.row - source.first_row(change.page);
        taken.push_back(const_cast<unsigned char*>(change.bytes));
        ++num_resident;
        ++pages_in;
        bytes_in += source.num_bytes(change.page);
    }
}

void PagePool::State::take_changes(bool is_bounded) {
    changes.clear();
    std::unique_lock<std::mutex> lock = is_bounded ? locked_at_once() : locked();
    if (!lock.owns_lock()) return;
    exchange();
    if (!is_bounded || decides_itself) {
        takes_all = !is_bounded;
        decide_next_round(lock);
        takes_all = false;
    }
    changes.swap(ready);
    ready_bytes = 0;
    has_noted = false;
    // A look waits until the pool has decided about its own view. An earlier one that was decided
    // about in between would bring pages to `ready`, and then no other view may be noted before the
    // next frame.
    if (!is_bounded) forget_noted();
    if (has_to_decide()) to_decide.notify_one();
    lock.unlock();
    take_ready();
}

PagePool::PagePool(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
                   std::shared_ptr<BlockMemory> memory)
    : state_(std::make_shared<State>(bundles, limits)) {
    state_->memory = std::move(memory);
    state_->read_roots(bundles.size());
    state_->allocate(bundles.size());
    state_->start_threads(state_);
}

// A thread that a disk never answers is left behind, with what it writes to. So is all in a child
// of fork(), whose copy of the threads' locks can never be destroyed.
PagePool::~PagePool() {
    if (getpid() != state_->process)
        static_cast<void>(new std::shared_ptr<State>(state_));
    else
        state_->stop_threads();
}

size_t PagePool::num_bundles() const { return state_->shift.size(); }
const SlotPlan& PagePool::plan() const { return state_->policy.plan(); }
bool PagePool::keeps_codes() const { return state_->limits.keeps_codes; }
int PagePool::max_sh_degree() const { return state_->max_sh_degree; }
Span<const int64_t> PagePool::shift(size_t b) const {
    return {state_->shift[b].data(), state_->shift[b].size()};
}
Span<const int32_t> PagePool::begins(size_t b) const {
    const uint32_t first = state_->policy.id_of(b, 0);
    return {state_->arrivals.begins().data() + first, state_->shift[b].size()};
}
const PageArrivals& PagePool::arrivals() const { return state_->arrivals; }
const PageSource& PagePool::source(uint32_t b) const { return state_->policy.source(b); }
SlotPage PagePool::slot_page(const PageChange& change) const {
    const PageSource& of = source(change.bundle);
    return {
        {of.clusters(change.page), reinterpret_cast<const uint32_t*>(change.bytes), of.sh_degree()},
        static_cast<size_t>(change.row),
        change.cluster,
        plan().num_clusters_at(change.cluster, of.num_clusters(change.page))};
}
size_t PagePool::most_changes() const { return 2 * state_->blocks.num_blocks() + num_bundles(); }
size_t PagePool::most_needs() const { return state_->most_needs; }
size_t PagePool::most_bytes_on_their_way() const { return state_->most_bytes; }

const std::vector<PageChange>& PagePool::begin_frame(bool is_bounded, Arrive arrive) {
    State& state = *state_;
    state.least_of_frame = state.least_tolerance;
    if (std::exchange(state.has_begun, true)) state.take_changes(is_bounded);  // else the coarsest
    const bool is_after_look = std::exchange(state.has_looked, !is_bounded);
    state.arrivals.advance(state.changes, is_bounded && !is_after_look ? arrive : Arrive::at_once);
    return state.changes;
}

void PagePool::set_most_bytes_a_frame(size_t bytes) { state_->most_bytes_a_frame = bytes; }

std::vector<unsigned char*> PagePool::take_blocks() { return std::exchange(state_->taken, {}); }

void PagePool::give_back(const std::vector<unsigned char*>& blocks) {
    state_->returned.insert(state_->returned.end(), blocks.begin(), blocks.end());
    const auto lock = state_->locked_at_once();
    if (lock.owns_lock()) state_->exchange();
}

void PagePool::release() { give_back(take_blocks()); }

FrameNeeds* PagePool::lend_needs() {
    State& state = *state_;
    if (state.idle_needs.empty()) state.idle_needs.push_back(std::exchange(state.to_note, nullptr));
    FrameNeeds* needs = state.idle_needs.back();
    state.idle_needs.pop_back();
    needs->least_px2 = state.least_of_frame;
    return needs;
}

NotedView PagePool::note_needs(FrameNeeds* needs, bool waits) {
    State& state = *state_;
    if (state.to_note != nullptr) state.idle_needs.push_back(state.to_note);
    state.to_note = needs;
    const uint64_t view = needs->view = ++state.views;
    NotedView noted;
    if (waits) noted.num_absent = state.count_absent(*needs);
    std::unique_lock<std::mutex> lock = waits ? state.locked() : state.locked_at_once();
    if (!lock.owns_lock()) return noted;
    state.exchange();
    if (waits || state.decides_itself) state.decide_next_round(lock);
    noted.is_decided = waits && state.decided_view == view;
    return noted;
}

void PagePool::give_up(FrameNeeds* needs) { state_->idle_needs.push_back(needs); }

float PagePool::least_tolerance_px2() const { return state_->least_of_frame; }

bool PagePool::raise_tolerance_at_once(float tolerance_px2) {
    const auto lock = state_->locked();
    if (state_->needed <= state_->policy.num_slots()) return false;
    state_->least_tolerance = std::max(tolerance_px2, 1e-6f) * kToleranceLeap;
    return true;
}

void PagePool::begin_settling() {
    State& state = *state_;
    auto lock = state.locked();
    state.exchange();
    state.forget_noted();
    // A round that is under way may adapt the tolerance at its end.
    state.has_changed.wait(lock, [&] { return !state.is_deciding(); });
    state.forget_failures();
    state.least_tolerance = 0;
}

void PagePool::check_process() const { state_->check_process(); }

bool PagePool::wait(double seconds) {
    State& state = *state_;
    auto lock = state.locked();
    state.has_changed.wait_for(lock, std::chrono::duration<double>(seconds), [&] {
        const bool is_decided =
            state.decides_itself || (!state.has_to_decide() && !state.is_deciding());
        return is_decided && (state.lacks_blocks || (state.todo.empty() && state.num_loading == 0));
    });
    return !state.ready.empty() || !state.read.empty();
}

bool PagePool::read_one() {
    auto lock = state_->locked();
    return state_->read_some(lock, 1);
}

PoolStatus PagePool::status() const {
    const State& state = *state_;
    state.check_process();
    PoolStatus status{state.policy.num_slots(),
                      state.num_resident,
                      state.needed,
                      state.missing,
                      state.failed,
                      state.pages_in,
                      state.bytes_in,
                      state.least_tolerance,
                      {},
                      false};
    if (status.failed == 0) return status;
    const auto lock = state.locked();
    status.error = state.error;
    status.is_damage = state.is_damage;
    return status;
}

}  // namespace v3dg
