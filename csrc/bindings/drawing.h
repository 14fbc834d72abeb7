#pragma once

// What drawing a frame gives Python: pictures, and what they came to.

#include <atomic>
#include <memory>
#include <mutex>
#include <utility>
#include <vector>

#include "bindings/picture.h"
#include "draw/scene_frame.h"

namespace v3dg {

// While it lives, one thread draws with a frame. Python's lock alone does not see to that, for
// torch gives it up while it looks for memory; and so it is given up here, too, where another
// thread has its turn. For backends whose frames share buffers.
class Turn {
  public:
    explicit Turn(std::mutex& mutex) : lock_(mutex, std::try_to_lock) {
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

// A frame that has been drawn, or enqueued on a device, with what it reads and writes. A backend
// whose drawings are not done when they are made derives from it.
class BoundDrawing {
  public:
    BoundDrawing(NewPictures pictures, const FrameStats& stats)
        : pictures_(std::move(pictures)), stats_(stats) {}
    virtual ~BoundDrawing() = default;
    BoundDrawing(const BoundDrawing&) = delete;
    BoundDrawing& operator=(const BoundDrawing&) = delete;

    const NewPicture& picture() const { return pictures_.front(); }
    const NewPicture& right() const { return pictures_.back(); }

    // Whether the device may still be at work on it.
    virtual bool is_under_way() const { return false; }
    // Keeps what it is drawn from until it is gone: the frame, which may have to draw again, and
    // what that reads.
    void keep(py::object kept) { kept_ = std::move(kept); }
    // Waits for the pictures.
    virtual const FrameStats& finish() { return stats_; }

  protected:
    NewPictures pictures_;
    FrameStats stats_;

  private:
    py::object kept_;  // gone after what a derived class has
};

}  // namespace v3dg
