// Reads batches of the most urgent pages. A reader takes a batch with the mutex locked,
// reads it without the mutex, and locks the mutex again to report the result.

#include "residency/pool_readers.h"

#include <algorithm>
#include <chrono>
#include <thread>

namespace v3dg {

namespace {

constexpr int kTries = 3;
// Number of pages that a thread announces to the disk together.
constexpr size_t kMostAtOnce = 64;
// Number of bytes of the pages that a thread reads and hashes together.
constexpr size_t kMostBytesTogether = size_t(512) << 10;

}  // namespace

bool PoolReaders::read_some(PoolShared& shared, size_t most) const {
    Reading batch[kMostAtOnce];
    size_t count = 0;
    while (count < most && !shared.todo.empty()) {
        const PageRequest next = shared.todo.back();
        std::atomic<PageState>& state = policy_.state(next.bundle, next.page);
        if (state == PageState::absent) {
            unsigned char* block =
                shared.blocks.take(policy_.source(next.bundle).num_bytes(next.page));
            if (block == nullptr) {
                shared.lacks_blocks = true;
                break;
            }
            state = PageState::loading;
            batch[count++] = {next, block};
        }
        shared.todo.pop_back();
    }
    shared.num_loading += count;
    if (count == 0) return false;
    const MutexUnlock unlocked(shared.busy);
    read_batch(shared, {batch, count});
    return true;
}

// Reads the pages in the order of the file. First announces all of them to the disk,
// then reads a few at a time.
void PoolReaders::read_batch(PoolShared& shared, Span<Reading> batch) const {
    std::sort(batch.begin(), batch.end(), [](const Reading& a, const Reading& b) {
        return a.page.bundle != b.page.bundle ? a.page.bundle < b.page.bundle
                                              : a.page.page < b.page.page;
    });
    PageReading pages[kMostAtOnce];
    for (size_t k = 0; k < batch.size; ++k) {
        pages[k].page = batch[k].page.page;
        pages[k].bytes = batch[k].block;
    }
    // Calls visit(bundle, pages) for runs of pages of one bundle. A run has one page,
    // or several with at most `most_bytes` bytes.
    const auto for_each_run = [&](size_t most_bytes, const auto& visit) {
        for (size_t first = 0, end = 0; first < batch.size; first = end) {
            const uint32_t bundle = batch[first].page.bundle;
            for (size_t bytes = 0; end < batch.size && batch[end].page.bundle == bundle; ++end) {
                bytes += policy_.source(bundle).num_bytes(pages[end].page);
                if (end > first && bytes > most_bytes) break;
            }
            visit(bundle, Span<PageReading>{pages + first, end - first});
        }
    };
    if (batch.size > 1)
        for_each_run(SIZE_MAX, [&](uint32_t bundle, Span<PageReading> run) {
            policy_.source(bundle).expect(run);
        });
    for_each_run(kMostBytesTogether, [&](uint32_t bundle, Span<PageReading> run) {
        read_together(shared, bundle, run);
    });
}

// Reads pages of one bundle. Reports the pages that were read, and tries the failed
// ones again.
void PoolReaders::read_together(PoolShared& shared, uint32_t bundle,
                                Span<PageReading> pages) const {
    policy_.source(bundle).read_pages(pages);
    {
        const MutexLock lock(shared.busy);
        for (const PageReading& reading : pages)
            if (!reading.error) finish(shared, bundle, reading);
    }
    for (PageReading& reading : pages) {
        if (!reading.error) continue;
        for (int tried = 1; tried < kTries && reading.error; ++tried) {
            std::this_thread::sleep_for(std::chrono::milliseconds(tried == 1 ? 5 : 50));
            reading.error.reset();
            policy_.source(bundle).read_pages({&reading, 1});
        }
        const MutexLock lock(shared.busy);
        finish(shared, bundle, reading);
    }
}

// Reports that a page was loaded or has failed.
void PoolReaders::finish(PoolShared& shared, uint32_t bundle, const PageReading& reading) const {
    --shared.num_loading;
    policy_.state(bundle, reading.page) = reading.error ? PageState::failed : PageState::loaded;
    if (!reading.error) {
        shared.read.push_back({.bundle = bundle,
                               .page = static_cast<uint32_t>(reading.page),
                               .block = reading.bytes});
        if (shared.has_to_decide()) shared.to_decide.notify_one();
    } else {
        shared.blocks.give_back(reading.bytes);
        ++shared.failed;
        shared.error = reading.error->what();
        shared.is_damage = reading.error->is_damage;
    }
    shared.has_changed.notify_all();
}

void PoolReaders::read_always(PoolShared& shared) const {
    const MutexLock lock(shared.busy);
    while (!shared.is_over) {
        // Take only a part of the list, so that all threads have something to read.
        const size_t share = shared.todo.size() / (2 * size_t(shared.limits.num_threads));
        if (read_some(shared, std::clamp<size_t>(share, 1, kMostAtOnce))) continue;
        shared.has_changed.notify_all();
        shared.to_read.wait(shared.busy);
    }
    --shared.num_threads;
    shared.has_changed.notify_all();
}

}  // namespace v3dg
