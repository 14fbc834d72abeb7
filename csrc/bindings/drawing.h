#pragma once

// The result of drawing a frame, for Python: pictures and statistics.

#include <atomic>
#include <memory>
#include <utility>
#include <vector>

#include "base/mutex.h"
#include "bindings/picture.h"
#include "draw/scene_frame.h"

namespace v3dg {

// Gives one thread exclusive use of a frame until this object is destroyed. The GIL
// does not suffice for this, because torch releases it during allocations. The
// constructor releases the GIL while it waits, because the thread that uses the frame
// may need the GIL. Only backends whose frames share buffers need a Turn.
class V3DG_SCOPED_CAPABILITY Turn {
  public:
    explicit Turn(Mutex& mutex) V3DG_ACQUIRE(mutex) : mutex_(mutex) { wait_for(mutex); }
    ~Turn() V3DG_RELEASE() { mutex_.unlock(); }
    Turn(const Turn&) = delete;
    Turn& operator=(const Turn&) = delete;

  private:
    // This function is not part of the constructor, because Clang's thread-safety
    // analysis skips constructors.
    static void wait_for(Mutex& mutex) V3DG_ACQUIRE(mutex) {
        if (mutex.try_lock()) return;
        const Unlocked unlocked;
        mutex.lock();
    }

    Mutex& mutex_;
};

// The statistics of a frame. Times are in milliseconds.
struct FrameStats {
    // Number of selected gaussians or, if exceeds_budget, of those in the coarsest cut.
    int64_t gaussians;
    uint64_t in_frustum, records, entries, items;
    float tolerance_px2;
    bool exceeds_budget;
    double select_ms, draw_ms;
    // Number of selected gaussians of each level. Only set on the host.
    std::vector<int64_t> levels;
    // How often the frame was drawn. It is above 1 if a buffer on the device was too
    // small.
    int num_draws = 1;
};

// A frame that was drawn, or enqueued on a device. A backend that returns before the
// frame is drawn uses a derived class.
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
    // Keeps a Python object alive as long as this drawing. It has the inputs of the
    // frame, which may be drawn again.
    void keep(py::object kept) { kept_ = std::move(kept); }
    // Waits until the pictures are drawn.
    virtual const FrameStats& finish() { return stats_; }

  protected:
    NewPictures pictures_;
    FrameStats stats_;

  private:
    py::object kept_;  // destroyed after the members of a derived class
};

}  // namespace v3dg
