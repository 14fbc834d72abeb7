// The CPU time of a pool of pages with about 40,000 pages in view, for the drawing thread and for
// the thread that decides which pages to read:
//
//   cmake --preset cpu && cmake --build build/cpu --target page_policy && build/cpu/page_policy
//
// The scene is a row of 169 generated bundles with 1.4 million pages. The pages in a window of the
// row are needed, and the pages of a margin around it are nearly needed. The window moves by 150
// pages per frame, and then jumps to the other end of the row. Nothing is drawn, and nothing is
// read from a disk. Two CPU times are measured: that of the drawing thread; and, in a pool without
// threads, that of all decisions.

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <memory>
#include <random>
#include <thread>
#include <vector>

#include <time.h>

#include "residency/host_pages.h"

namespace {

using namespace v3dg;

constexpr int32_t kBundles = 169, kPages = 4096;  // pages of the finest level of a bundle
constexpr int64_t kRows = 200;                    // gaussians of a cluster
constexpr size_t kSlots = 120000;
constexpr size_t kNeeds = 40000,
                 kNearly = 10000;  // pages of the window, and of the margin at each end

// A page has two clusters. Each level has half as many pages as the next finer one; the coarsest
// level has one.
struct Tree {
    std::vector<int32_t> level, own, parent;
    std::vector<int64_t> offset;
    std::vector<float> weight;
    std::vector<Ball> ball;

    Tree() {
        own.assign(2 * kPages, -1);
        for (int32_t c = 0; c < 2 * kPages; ++c) parent.push_back(c / 2);
        int32_t first = 0;
        for (int32_t count = kPages, number = 1; count > 0; first += count, count /= 2, ++number)
            for (int32_t k = 0; k < count; ++k) {
                level.push_back(number);
                own.push_back(first + k);
                parent.push_back(count > 1 ? first + count + k / 2 : -1);
            }
        for (size_t c = 0; c <= own.size(); ++c) offset.push_back(kRows * static_cast<int64_t>(c));
        weight.resize(level.size());
        ball.resize(level.size());
    }
    ClusterTable table() const {
        ClusterTable table{};
        table.ball = {ball.data(), ball.size()};
        table.weight = {weight.data(), weight.size()};
        table.level = {level.data(), level.size()};
        table.own_group = {own.data(), own.size()};
        table.parent_group = {parent.data(), parent.size()};
        table.offset = {offset.data(), offset.size()};
        return table;
    }
};

struct NoPages : PageSource {
    using PageSource::PageSource;
    size_t num_bytes(size_t page) const override { return 24 * num_rows(page); }
    void read_pages(Span<PageReading> pages) const override {
        for (const PageReading& of : pages) of.bytes[0] = 1;
    }
};

double processor_us() {
    timespec now{};
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return 1e6 * static_cast<double>(now.tv_sec) + 1e-3 * static_cast<double>(now.tv_nsec);
}

class Flight {
  public:
    explicit Flight(PagePool& pool, bool reads) : pool_(pool), reads_(reads) {}

    // Runs a frame of the window that begins at page `first`, and records the time of this thread.
    void frame(size_t first) {
        const double begin = processor_us();
        pool_.begin_frame(true, Arrive::fading);
        pool_.release();
        static_cast<void>(pool_.status());
        FrameNeeds* needs = pool_.lend_needs();
        double not_counted = processor_us();
        fill(*needs, first);
        not_counted = processor_us() - not_counted;
        pool_.note_needs(needs, false);
        static_cast<void>(pool_.status());
        us_.push_back(processor_us() - begin - not_counted);
        while (reads_ && pool_.read_one()) {
        }
        if (!reads_) std::this_thread::sleep_for(std::chrono::milliseconds(6));
    }
    void report(const char* what) {
        std::sort(us_.begin(), us_.end());
        const auto at = [&](double share) {
            return us_[static_cast<size_t>(share * double(us_.size() - 1))];
        };
        std::printf("%s %s: %zu frames, us median %.0f, p99 %.0f, worst %.0f\n",
                    reads_ ? "all that is decided" : "the thread that draws", what, us_.size(),
                    at(0.5), at(0.99), at(1));
        us_.clear();
    }

  private:
    // The order is arbitrary, like that of thread blocks on a GPU.
    void fill(FrameNeeds& needs, size_t first) {
        for (size_t k = 0; k < kNeeds; ++k) {
            const size_t page = first + k;
            const bool is_needed = k >= kNearly && k < kNeeds - kNearly;
            needs.list[k] = {static_cast<uint32_t>(page / kPages),
                             static_cast<uint32_t>(page % kPages),
                             is_needed ? 1.5f + 0.1f * static_cast<float>(k % 7) : 0.7f};
        }
        for (size_t k = 0; k + 64 <= kNeeds; k += 64)
            std::swap_ranges(needs.list + k, needs.list + k + 64,
                             needs.list + random_() % (kNeeds / 64) * 64);
        needs.count = kNeeds;
        needs.num_left_out = 0;
        needs.tolerance_px2 = 1;
        needs.adapts = true;
    }

    PagePool& pool_;
    const bool reads_;
    std::mt19937 random_{1};
    std::vector<double> us_;
};

void fly(unsigned num_threads) {
    const Tree tree;
    std::vector<PagedBundle> bundles;
    for (int32_t b = 0; b < kBundles; ++b)
        bundles.push_back(
            {tree.table(), std::make_shared<NoPages>(tree.table(), 0, PageCodec::quantized)});
    PoolLimits limits{};
    limits.memory = {kSlots * 2 * kRows + kBundles * kRows, 1, 0};
    limits.num_threads = num_threads;
    PagePool pool(bundles, limits, std::make_shared<HostBlocks>());
    Flight flight(pool, num_threads == 0);
    const auto settle = [&](size_t at) {
        for (int k = 0; k < 4 || (pool.status().missing > 0 && k < 2000); ++k) flight.frame(at);
    };
    settle(0);
    flight.report("from nothing");
    size_t at = 0;
    for (int k = 0; k < 300; ++k) flight.frame(at += 150);
    flight.report("in a flight");
    settle(at + 300000);
    flight.report("after a teleport");
}

}  // namespace

int main() {
    fly(4);
    fly(0);
}
