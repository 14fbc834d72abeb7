#pragma once

// Frames on a CUDA device, from items to pixels, and drawings in progress.

#include <deque>
#include <functional>
#include <memory>
#include <utility>
#include <vector>

#include "base/device.h"
#include "frame/tile_list.h"
#include "project/project_cuda.h"
#include "rasterize/rasterize.h"
#include "tile_bin/tile_bin.h"

namespace v3dg {
namespace cuda {

// The input of a frame; device memory in it must stay unchanged until the frame is
// drawn.
struct FrameBatch {
    const GaussianRows<const float>* models;
    const Placement* placements;
    const FrameImage* images;
    uint32_t num_images, num_tiles;  // sum over all images
    // See ProjectInput.
    const PackedPlanes* packed = nullptr;
    const CodedGaussians* coded = nullptr;
    bool has_shared_items = false;  // whether any may be shared; never with a tape
    // Of the images; kStopsByCut only with a budget.
    float min_transmittance = kStopsBefore;
    // Whether any may be faded; only items of scenes, which are not shared.
    bool has_faded_items = false;
    const InstanceFactors* factors = nullptr;  // [num_factors], or null
    uint32_t num_factors = 0;
    // The mutex that guards the models, if these change from frame to frame. The caller
    // holds it while it draws.
    StreamMutex* guards_models = nullptr;
    size_t num_zeros = 0;  // size of ItemList::zeros
    // Whether any image that has a destination is drawn with depth.
    bool has_depth = true;
};

// The output of a frame for its backward pass, valid until the next frame is drawn.
struct FrameTape {
    FrameLists lists;
    RasterTape raster;
    const GaussianRows<const float>* models;
    const Placement* placements;
    const DrawItem* items;         // counters->items elements
    const uint32_t* item_records;  // number of records per item
    const uint32_t* source;        // of each record: index of its gaussian in the model
    const uint32_t* first_slot;    // of each record, set by place_slots()
};

struct FrameTimes {
    float prepare_ms, draw_ms;
};

class Drawing;

// Draws batches of pictures: project, bin, blend. It reuses its buffers from frame to
// frame.
//
// Counts stay on the device, so draw() never waits. A frame whose buffers are too small
// draws nothing. finish() of its Drawing detects that, enlarges the buffers and draws
// again; hence pictures must be read only after finish(). Frames may be enqueued on any
// streams, one after another.
class Frame {
  public:
    enum class Keeps { nothing, tape };

    explicit Frame(Keeps keeps = Keeps::nothing);
    ~Frame();
    Frame(const Frame&) = delete;
    Frame& operator=(const Frame&) = delete;

    // Enqueues the work that writes the batch's items and, unless they exist, its
    // tables. It is called again when a frame is drawn again. The counters are zero at
    // that point.
    using Prepare = std::function<void(const ItemList& items, cudaStream_t stream)>;

    // Provides the destinations of images that have none. It is called once, after work
    // for the device was enqueued.
    using Place = std::function<void(PicturePlanes planes[2])>;

    // Enqueues a frame. While `stream` captures a graph nothing is allocated; so draw a
    // frame of the same size before the capture. The buffers of a captured frame exist
    // as long as this object.
    std::unique_ptr<Drawing> draw(const FrameBatch& batch, Prepare prepare, cudaStream_t stream,
                                  const Place& place = {});

    // Returns the bytes on the device by part.
    std::vector<std::pair<const char*, size_t>> bytes() const;

    // Returns the tape of the last frame; requires Keeps::tape.
    FrameTape tape() const;

  private:
    friend class Drawing;
    struct Slot;
    struct State;
    void enqueue(Drawing& drawing, const Place& place);
    // Returns the lists in the current buffers.
    FrameLists lists(const FrameBatch& batch) const;
    RecordPlanes records() const;
    void enlarge(const FrameCounters& counters);
    Slot* take_slot(bool capturing);
    template <class T>
    T* room(DeviceBuffer<T>& buffer, size_t size, const Drawing& drawing);

    const Keeps keeps_;
    Capacity capacity_{64, 4096, 4096, 4096, 4096};
    DeviceBuffer<DrawItem> items_;
    DeviceBuffer<uint32_t> item_records_, source_, first_slot_, image_of_tile_, order_, blended_;
    DeviceBuffer<float> records_;
    DeviceBuffer<RecordBox> boxes_;
    DeviceBuffer<ItemTiles> item_tiles_;
    DeviceBuffer<LargeRecord> large_;
    DeviceBuffer<TileEntry> entries_;
    DeviceBuffer<unsigned long long>
        scratch_;  // tile lists of small records, later lists that are spread
    DeviceBuffer<unsigned long long> tile_first_;
    DeviceBuffer<TilePlan> plans_;
    uint32_t num_plans_ = 0;
    DeviceBuffer<unsigned char> cleared_;  // State, scan states, zeros of items, tile counts
    size_t num_zero_bytes_ = 0;  // bytes of `cleared_` that are zero when the next frame begins

    std::vector<std::unique_ptr<Slot>> slots_;
    std::deque<Slot*> free_slots_;                // slots whose frames may still be in flight
    std::vector<std::shared_ptr<void>> retired_;  // buffers that captured graphs still use
    bool was_captured_ = false;
    Drawing* last_ = nullptr;
    FrameBatch last_batch_{};
    cudaStream_t last_stream_ = nullptr;
    StreamMutex busy_;
};

// A frame that has been enqueued. The Frame must outlive it.
class Drawing {
  public:
    ~Drawing();
    Drawing(const Drawing&) = delete;
    Drawing& operator=(const Drawing&) = delete;

    // Waits until the device has finished the drawing; finish() may still draw it
    // again.
    void wait() const;
    // Like finish(), but the pictures may still be in progress. With a tape, it waits
    // only until all counts are known. Not allowed for a captured frame.
    const FrameCounters& settle();
    // Waits until the pictures are drawn, and draws again if a buffer was too small.
    // Throws OutOfMemory, or std::length_error beyond kMostFrameRecords.
    //
    // For a captured frame, it reports the last replay, which must have ended; throws
    // std::runtime_error if a buffer was too small.
    const FrameCounters& finish();
    FrameTimes times() const;
    // Returns how often the frame was drawn: more than once if buffers were too small.
    // Known after finish().
    int num_draws() const { return num_draws_; }

  private:
    friend class Frame;
    Drawing(Frame& frame, const FrameBatch& batch, Frame::Prepare prepare, cudaStream_t stream);
    bool was_drawn() const;

    Frame& frame_;
    FrameBatch batch_;
    Frame::Prepare prepare_;
    cudaStream_t stream_;
    Frame::Slot* slot_ = nullptr;
    Capacity capacity_{};  // capacity with which it was drawn
    PicturePlanes planes_[2]{};
    bool is_captured_ = false, is_settled_ = false;
    int num_draws_ = 1;
};

}  // namespace cuda
}  // namespace v3dg
