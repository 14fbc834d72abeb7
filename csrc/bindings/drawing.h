#pragma once

// What drawing a frame gives Python: pictures, and what they came to.

#include <atomic>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

#include "bindings/picture.h"
#include "draw/scene_frame.h"

#if V3DG_WITH_CUDA
#include "draw/device_pages.h"
#include "draw/scene_frame_cuda.h"
#endif

namespace v3dg {

// Asks, from any thread, for work under way to end early.
class Stop {
  public:
    void request() { requested_.store(true, std::memory_order_relaxed); }
    bool is_requested() const { return requested_.load(std::memory_order_relaxed); }
    const std::atomic<bool>* flag() const { return &requested_; }

  private:
    std::atomic<bool> requested_{false};
};

inline const std::atomic<bool>* flag_of(const Stop* stop) {
    return stop == nullptr ? nullptr : stop->flag();
}

// While it lives, one thread draws with a frame. Python's lock alone does not see to that, for
// torch gives it up while it looks for memory; and so it is given up here, too, where another
// thread has its turn.
class Turn {
  public:
    explicit Turn(std::mutex* mutex) {
        if (mutex == nullptr) return;  // on the host, where frames have nothing that they share
        lock_ = std::unique_lock<std::mutex>(*mutex, std::try_to_lock);
        if (lock_.owns_lock()) return;
        const Unlocked unlocked;
        lock_.lock();
    }

  private:
    std::unique_lock<std::mutex> lock_;
};

// What a frame came to; times in milliseconds.
struct FrameStats {
    int64_t gaussians;  // selected; where the budget is exceeded, what the coarsest cut has
    uint64_t in_frustum, records, entries, items;
    float tolerance_px2;
    bool exceeds_budget;
    double select_ms, draw_ms;
    std::vector<int64_t> levels;  // on the host, gaussians selected by level
    int num_draws = 1;  // more where buffers on a device were too small, and it was drawn again
};

inline FrameStats stats_of(const SceneFrameCounts& c) {
    return {c.gaussians,
            c.render.in_frustum,
            c.render.records,
            c.render.entries,
            0,
            c.tolerance_px2,
            c.exceeds_budget,
            1e3 * c.select_seconds,
            1e3 * c.draw_seconds,
            c.levels,
            1};
}

// The pictures of a frame: of a camera, or of two eyes, left first.
using NewPictures = std::vector<NewPicture>;

// A frame that has been drawn, or enqueued on a device, with what it reads and writes.
class BoundDrawing {
  public:
    BoundDrawing(NewPictures pictures, const FrameStats& stats)
        : pictures_(std::move(pictures)), stats_(stats) {}

#if V3DG_WITH_CUDA
    // `kept` are the frame, which may have to draw again, and what it reads.
    BoundDrawing(NewPictures pictures, py::object kept, Device device,
                 std::shared_ptr<std::mutex> turns, std::unique_ptr<cuda::Drawing> drawing,
                 const SelectRule& rule, cuda::DevicePages* pages = nullptr)
        : pictures_(std::move(pictures)),
          kept_(std::move(kept)),
          device_(device),
          turns_(std::move(turns)),
          drawing_(std::move(drawing)),
          pages_(pages),
          rule_(rule) {}
#endif

    const NewPicture& picture() const { return pictures_.front(); }
    const NewPicture& right() const { return pictures_.back(); }

    const FrameStats& finish() {
#if V3DG_WITH_CUDA
        if (drawing_ != nullptr) {
            const Work work(device_);
            {
                const Unlocked unlocked;
                drawing_->wait();
            }
            const Turn turn(turns_.get());
            const cuda::FrameCounters& c = drawing_->finish();  // may draw
            if (pages_ != nullptr) pages_->note_frames(work.stream());
            const cuda::FrameTimes times = drawing_->times();
            const bool exceeds = c.choice.exceeds_budget;
            stats_ = {
                static_cast<int64_t>(exceeds ? c.choice.least : c.gaussians / pictures_.size()),
                c.in_frustum,
                c.records,
                c.entries,
                c.items,
                rule_.budget == kNoBudget ? rule_.tolerance_px2 : c.choice.tolerance_px2,
                exceeds,
                times.prepare_ms,
                times.draw_ms,
                {},
                drawing_->num_draws()};
        }
#endif
        return stats_;
    }

  private:
    NewPictures pictures_;
    FrameStats stats_{};
#if V3DG_WITH_CUDA
    py::object kept_;
    Device device_;
    std::shared_ptr<std::mutex> turns_;       // of the frame
    std::unique_ptr<cuda::Drawing> drawing_;  // gone before what it needs
    cuda::DevicePages* pages_ = nullptr;      // of the pool that it draws from, which `kept_` has
    SelectRule rule_{};
#endif
};

inline NewPicture picture_of(const Window& window, bool with_depth) {
    return {window.height(), window.width(), {}, {}, py::none(), with_depth};
}

// On the host, new pictures of the windows of the eyes.
struct HostPictures {
    NewPictures out;
    std::vector<Picture<float>> pictures;

    HostPictures(const Eyes& eyes, const Shade& shade) {
        for (int k = 0; k < eyes.count(); ++k) {
            const Window window = window_of(eyes.camera[k]);
            out.push_back(picture_of(window, shade.with_depth));
            pictures.push_back(out.back().on_host<float>(window, shade));
        }
    }
    Span<const Picture<float>> span() const { return {pictures.data(), pictures.size()}; }
};

}  // namespace v3dg
