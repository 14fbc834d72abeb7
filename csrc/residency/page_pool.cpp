// Implements page_pool.h. It creates the parts of a pool, which pool_shared.h lists,
// starts and ends its threads, and has the functions that belong to no single part.

#include "residency/page_pool.h"

#include <algorithm>
#include <chrono>
#include <thread>
#include <utility>

#include "residency/pool_decider.h"
#include "residency/pool_frames.h"
#include "residency/pool_readers.h"
#include "residency/pool_shared.h"

namespace v3dg {

namespace {

constexpr float kToleranceLeap = 1.189207f;
constexpr float kLeastToleranceRaised = 1e-6f;
// Approximate number of pages whose sizes are sampled.
constexpr size_t kSamples = 1 << 14;
// The longest time for which the destructor of a pool waits for its threads.
constexpr std::chrono::seconds kMostWaitForEnd{2};

// Returns the sizes of about kSamples pages, without coarsest pages.
std::vector<size_t> sampled_sizes(const PagePolicy& policy, size_t num_bundles) {
    std::vector<size_t> samples;
    const size_t step = policy.num_pages() / kSamples + 1;
    for (size_t b = 0; b < num_bundles; ++b) {
        const PageSource& source = policy.source(b);
        for (size_t p = b % step; p + 1 < source.num_pages(); p += step)
            samples.push_back(source.num_bytes(p));
    }
    return samples;
}

}  // namespace

struct PagePool::State {
    State(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
          std::shared_ptr<BlockMemory> block_memory);

    static void start_threads(const std::shared_ptr<State>& state);
    void stop_threads();

    // After construction, only the decider uses those parts of the policy that change.
    PagePolicy policy;
    std::shared_ptr<BlockMemory> memory;
    int max_sh_degree = 0;
    size_t most_needs = 0;
    size_t most_bytes = 0;    // total size of all blocks and coarsest pages
    size_t most_changes = 0;  // largest number of page changes in a frame

    PoolShared shared;
    PoolDecider decider;
    PoolReaders readers;
    PoolFrames frames;
};

// Allocates all memory that the threads write to, so that no thread can run out of
// memory.
PagePool::State::State(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
                       std::shared_ptr<BlockMemory> block_memory)
    : policy(bundles, limits.memory),
      memory(std::move(block_memory)),
      shared(limits, policy.num_slots()),
      decider(policy),
      readers(policy),
      frames(policy, decider, bundles.size()) {
    for (size_t b = 0; b < bundles.size(); ++b)
        max_sh_degree = std::max(max_sh_degree, policy.source(b).sh_degree());
    const size_t root_bytes = frames.read_roots(*memory);

    const MutexLock lock(shared.busy);
    shared.blocks.allocate(sampled_sizes(policy, bundles.size()), policy.most_page_bytes(),
                           limits.block_bytes, policy.num_slots(), *memory);
    const size_t num_blocks = shared.blocks.num_blocks();
    most_bytes = root_bytes + shared.blocks.num_bytes();
    most_changes = 2 * num_blocks + bundles.size();
    // Requests beyond this number are dropped. A page usually has two clusters, each of
    // which may request another page; eight requests per slot leave room for larger
    // groups.
    most_needs = std::min(policy.num_pages(), 8 * policy.num_slots() + 1024);
    decider.reserve(num_blocks, most_changes);
    shared.read.reserve(num_blocks);
    shared.ready.reserve(most_changes);
    shared.free_needs.reserve(limits.most_frames + 2);
    frames.reserve(num_blocks, most_changes, limits.most_frames, most_needs, *memory);
}

void PagePool::State::start_threads(const std::shared_ptr<State>& state) {
    PoolShared& shared = state->shared;
    if (!shared.has_threads) return;
    try {
        for (unsigned t = 0; t <= shared.limits.num_threads; ++t) {
            const MutexLock lock(shared.busy);
            std::thread([state, t] {
                if (t == 0)
                    state->decider.decide_always(state->shared);
                else
                    state->readers.read_always(state->shared);
            }).detach();
            ++shared.num_threads;
        }
    } catch (...) {
        state->stop_threads();
        throw;
    }
}

void PagePool::State::stop_threads() {
    const MutexLock lock(shared.busy);
    shared.is_over = true;
    shared.to_decide.notify_all();
    shared.to_read.notify_all();
    const Condition::Time end = std::chrono::steady_clock::now() + kMostWaitForEnd;
    while (shared.num_threads > 0 && shared.has_changed.wait_until(shared.busy, end)) {
    }
}

PagePool::PagePool(const std::vector<PagedBundle>& bundles, const PoolLimits& limits,
                   std::shared_ptr<BlockMemory> memory)
    : state_(std::make_shared<State>(bundles, limits, std::move(memory))) {
    State::start_threads(state_);
}

// The state may outlive the pool in two cases. A thread that waits for a disk forever
// writes to its state later. In a child of fork(), the mutex in the state must not be
// destroyed.
PagePool::~PagePool() {
    if (process_id() != state_->shared.process)
        static_cast<void>(new std::shared_ptr<State>(state_));
    else
        state_->stop_threads();
}

size_t PagePool::num_bundles() const { return state_->frames.num_bundles(); }
const SlotPlan& PagePool::plan() const { return state_->policy.plan(); }
bool PagePool::keeps_codes() const { return state_->shared.limits.keeps_codes; }
int PagePool::max_sh_degree() const { return state_->max_sh_degree; }
Span<const int64_t> PagePool::shift(size_t bundle) const {
    const std::vector<int64_t>& shift = state_->frames.shift(bundle);
    return {shift.data(), shift.size()};
}
Span<const int32_t> PagePool::begins(size_t bundle) const {
    const uint32_t first = state_->policy.id_of(bundle, 0);
    return {arrivals().begins().data() + first, state_->frames.shift(bundle).size()};
}
const PageArrivals& PagePool::arrivals() const { return state_->frames.arrivals(); }
const PageSource& PagePool::source(uint32_t bundle) const { return state_->policy.source(bundle); }
SlotPage PagePool::slot_page(const PageChange& change) const {
    const PageSource& bundle = source(change.bundle);
    const size_t num_clusters = bundle.num_clusters(change.page);
    return {.page = {bundle.clusters(change.page), reinterpret_cast<const uint32_t*>(change.bytes),
                     bundle.sh_degree()},
            .row = static_cast<size_t>(change.row),
            .cluster = change.cluster,
            .num_clusters = plan().num_clusters_at(change.cluster, num_clusters)};
}
size_t PagePool::most_changes() const { return state_->most_changes; }
size_t PagePool::most_needs() const { return state_->most_needs; }
size_t PagePool::most_bytes_on_their_way() const { return state_->most_bytes; }

const std::vector<PageChange>& PagePool::begin_frame(bool is_bounded, Arrive arrive) {
    return state_->frames.begin_frame(state_->shared, is_bounded, arrive);
}
void PagePool::set_most_bytes_a_frame(size_t bytes) { state_->shared.most_bytes_a_frame = bytes; }
std::vector<unsigned char*> PagePool::take_blocks() { return state_->frames.take_blocks(); }
void PagePool::give_back(const std::vector<unsigned char*>& blocks) {
    state_->frames.give_back(state_->shared, blocks);
}
void PagePool::release() { give_back(take_blocks()); }

FrameNeeds* PagePool::lend_needs() { return state_->frames.lend_needs(); }
NotedView PagePool::note_needs(FrameNeeds* needs, bool waits) {
    return state_->frames.note_needs(state_->shared, needs, waits);
}
void PagePool::give_up(FrameNeeds* needs) { state_->frames.give_up(needs); }
float PagePool::least_tolerance_px2() const { return state_->frames.least_tolerance_px2(); }

bool PagePool::raise_tolerance_at_once(float tolerance_px2) {
    PoolShared& shared = state_->shared;
    const PoolLock lock(shared);
    if (shared.needed <= state_->policy.num_slots()) return false;
    shared.least_tolerance = std::max(tolerance_px2, kLeastToleranceRaised) * kToleranceLeap;
    return true;
}

void PagePool::begin_settling() { state_->frames.begin_settling(state_->shared); }
void PagePool::check_process() const { state_->shared.check_process(); }

bool PagePool::wait(double seconds) {
    PoolShared& shared = state_->shared;
    const PoolLock lock(shared);
    const Condition::Time end =
        std::chrono::steady_clock::now() + std::chrono::ceil<std::chrono::steady_clock::duration>(
                                               std::chrono::duration<double>(seconds));
    while (!shared.is_idle() && shared.has_changed.wait_until(shared.busy, end)) {
    }
    return !shared.ready.empty() || !shared.read.empty();
}

bool PagePool::read_one() {
    PoolShared& shared = state_->shared;
    const PoolLock lock(shared);
    return state_->readers.read_some(shared, 1);
}

PoolStatus PagePool::status() const {
    PoolShared& shared = state_->shared;
    shared.check_process();
    PoolStatus status{.num_slots = state_->policy.num_slots(),
                      .num_resident = shared.num_resident,
                      .needed = shared.needed,
                      .missing = shared.missing,
                      .failed = shared.failed,
                      .pages_in = shared.pages_in,
                      .bytes_in = shared.bytes_in,
                      .least_tolerance_px2 = shared.least_tolerance,
                      .error = {},
                      .is_damage = false};
    if (status.failed == 0) return status;
    const PoolLock lock(shared);
    status.error = shared.error;
    status.is_damage = shared.is_damage;
    return status;
}

}  // namespace v3dg
