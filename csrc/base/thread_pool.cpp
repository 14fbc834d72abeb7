// The threads of parallel loops without OpenMP. All loops share one pool of threads.
//
// A loop runs on the thread that starts it and on the idle threads of the pool, so it
// ends even if the pool has no threads. A nested loop runs only on its own thread, as
// with OpenMP.

#ifndef _OPENMP

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <memory>
#include <system_error>
#include <vector>

#include "base/mutex.h"
#include "base/process.h"
#include "base/threads.h"

#if V3DG_HAS_THREADS
#include <thread>
#endif

namespace v3dg {

namespace {

struct ThreadState {
    int index = 0;
    bool is_in_loop = false;
    bool is_alone = false;  // starts no other threads
};
thread_local ThreadState state;

// Runs the work as thread `index` of a loop.
void run_as(int index, void (*work)(void*), void* context) {
    const ThreadState before = state;
    state.index = index;
    state.is_in_loop = true;
    work(context);
    state = before;
}

#if V3DG_HAS_THREADS

constexpr int kMostThreads = 1024;

struct Loop {
    void (*work)(void*);
    void* context;
    int num_threads;
    int num_started = 1;  // the thread that started the loop has the number 0
    int num_running = 0;
};

class ThreadPool {
  public:
    // Returns the pool of this process. In a child of fork(), the pool of the parent is
    // not used, because its threads do not exist there. It is not destroyed there
    // either.
    static ThreadPool& of_process() {
        static std::atomic<ThreadPool*> pool{nullptr};
        ThreadPool* current = pool.load();
        if (current != nullptr && current->process_ == process_id()) return *current;
        auto made = std::make_unique<ThreadPool>();
        if (pool.compare_exchange_strong(current, made.get())) return *made.release();
        return *current;  // another thread has set it first
    }

    void run(Loop& loop) V3DG_EXCLUDES(busy_) {
        {
            const MutexLock lock(busy_);
            start_threads(loop.num_threads - 1);
            loops_.push_back(&loop);
            has_work_.notify_all();
        }
        run_as(0, loop.work, loop.context);
        const MutexLock lock(busy_);
        remove(loop);
        while (loop.num_running > 0) is_finished_.wait(busy_);
    }

  private:
    // Starts threads until there are `count`, or until the system cannot start more.
    void start_threads(int count) V3DG_REQUIRES(busy_) {
        try {
            for (; num_threads_ < count; ++num_threads_) std::thread([this] { help(); }).detach();
        } catch (const std::system_error&) {
            return;
        }
    }
    void remove(const Loop& loop) V3DG_REQUIRES(busy_) {
        loops_.erase(std::remove(loops_.begin(), loops_.end(), &loop), loops_.end());
    }
    void help() V3DG_EXCLUDES(busy_) {
        const MutexLock lock(busy_);
        for (;;) {
            while (loops_.empty()) has_work_.wait(busy_);
            Loop& loop = *loops_.front();
            const int index = loop.num_started++;
            ++loop.num_running;
            if (loop.num_started == loop.num_threads) remove(loop);
            {
                const MutexUnlock unlocked(busy_);
                run_as(index, loop.work, loop.context);
            }
            if (--loop.num_running == 0) is_finished_.notify_all();
        }
    }

    const int64_t process_ = process_id();
    Mutex busy_;
    Condition has_work_, is_finished_;
    std::vector<Loop*> loops_ V3DG_GUARDED_BY(busy_);  // loops that need more threads
    int num_threads_ V3DG_GUARDED_BY(busy_) = 0;
};

int wanted_threads() {
    const char* const text = std::getenv("OMP_NUM_THREADS");
    const int wanted = text == nullptr ? 0 : std::atoi(text);
    const int count = wanted > 0 ? wanted : static_cast<int>(std::thread::hardware_concurrency());
    return std::clamp(count, 1, kMostThreads);
}

#endif  // V3DG_HAS_THREADS

}  // namespace

int most_threads() {
#if V3DG_HAS_THREADS
    static const int most = wanted_threads();
    return state.is_alone ? 1 : most;
#else
    return 1;
#endif
}

int thread_index() { return state.index; }

bool is_in_parallel() { return state.is_in_loop; }

void use_one_thread() { state.is_alone = true; }

void run_on_threads(int num_threads, void (*work)(void* context), void* context) {
#if V3DG_HAS_THREADS
    if (num_threads > 1 && !state.is_in_loop) {
        Loop loop = {.work = work, .context = context, .num_threads = num_threads};
        ThreadPool::of_process().run(loop);
        return;
    }
#else
    static_cast<void>(num_threads);
#endif
    run_as(0, work, context);
}

}  // namespace v3dg

#endif  // _OPENMP
