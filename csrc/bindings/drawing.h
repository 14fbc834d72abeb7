#pragma once

// The result of drawing a frame for Python: pictures and statistics.

#include <atomic>
#include <memory>
#include <utility>
#include <vector>

#include "base/mutex.h"
#include "bindings/picture.h"
#include "draw/scene_frame.h"

namespace v3dg {

// A Turn gives one thread exclusive use of a frame until the Turn is destroyed.
// Python's lock does not suffice, because torch releases that lock during allocations.
// The constructor waits without Python's lock, which the other thread may need to
// finish. Used by backends whose frames share buffers.
class V3DG_SCOPED_CAPABILITY Turn {
  public:
    explicit Turn(Mutex& mutex) V3DG_ACQUIRE(mutex) : mutex_(mutex) { wait_for(mutex); }
    ~Turn() V3DG_RELEASE() { mutex_.unlock(); }
    Turn(const Turn&) = delete;
    Turn& operator=(const Turn&) = delete;

  private:
    // Clang checks no constructors, so the lock is not in the constructor.
    static void wait_for(Mutex& mutex) V3DG_ACQUIRE(mutex) {
        if (mutex.try_lock()) return;
        const Unlocked unlocked;
        mutex.lock();
    }

    Mutex& mutex_;
};

// The statistics of a frame; times are in milliseconds.
struct FrameStats {
    int64_t gaussians;  // selected gaussians; if the budget is exceeded, those of the coarsest cut
    uint64_t in_frustum, records, entries, items;
    float tolerance_px2;
    bool exceeds_budget;
    double select_ms, draw_ms;
    std::vector<int64_t> levels;  // on the host: selected gaussians by level
    // Above 1 if buffers on a device were too small, so that the frame was drawn again.
    int num_draws = 1;
};

// A frame that has been drawn, or enqueued on a device, with its inputs and outputs. A
// backend that returns before the frame is drawn uses a derived class.
class BoundDrawing {
  public:
    BoundDrawing(NewPictures pictures, const FrameStats& stats)
        : pictures_(std::move(pictures)), stats_(stats) {}
    virtual ~BoundDrawing() = default;
    BoundDrawing(const BoundDrawing&) = delete;
    BoundDrawing& operator=(const BoundDrawing&) = delete;

    const NewPicture& picture() const { return pictures_.front(); }
    const NewPicture& right() const { return pictures_.back(); }

    // Returns whether the device may still be drawing.
    virtual bool is_under_way() const { return false; }
    // Keeps an input alive as long as this object: the frame, which may have to draw
    // again, and what the frame reads.
    void keep(py::object kept) { kept_ = std::move(kept); }
    // Waits for the pictures.
    virtual const FrameStats& finish() { return stats_; }

  protected:
    NewPictures pictures_;
    FrameStats stats_;

  private:
    py::object kept_;  // destroyed after the members of a derived class
};

}  // namespace v3dg
