#pragma once

// Frames on a CUDA device, from items to pixels, and drawings that are under way.

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

// What a frame draws; device memory that stays as it is until the frame is drawn.
struct FrameBatch {
    const GaussianRows<const float>* models;
    const Placement* placements;
    const FrameImage* images;
    uint32_t num_images, num_tiles;  // of all images together
    // As ProjectInput has them.
    const PackedPlanes* packed = nullptr;
    const CodedGaussians* coded = nullptr;
    bool has_shared_items = false;  // whether there may be any; a frame that keeps a tape has none
    float min_transmittance = kStopsBefore;  // of the images
    bool has_faded_items = false;  // the same as of shared ones; these are of scenes and not shared
    const InstanceFactors* factors = nullptr;
    uint32_t num_factors = 0;
    // Where the models change from frame to frame: what guards them. Whoever draws has it locked.
    StreamMutex* guards_models = nullptr;
    size_t num_zeros = 0;  // that ItemList is to have
    // Whether an image that says where it is may be drawn with depth: true if one is.
    bool has_depth = true;
};

// What a frame leaves for its backward pass, valid until the next frame is drawn.
struct FrameTape {
    FrameLists lists;
    RasterTape raster;
    const GaussianRows<const float>* models;
    const Placement* placements;
    const DrawItem* items;         // counters->items
    const uint32_t* item_records;  // how many of an item's gaussians became records
    const uint32_t* source;        // of each record, its gaussian's place in the model
    const uint32_t* first_slot;    // of each record, as place_slots() gives them
};

struct FrameTimes {
    float prepare_ms, draw_ms;
};

class Drawing;

// Draws batches of pictures: project, bin, blend. Keeps its buffers from frame to frame.
//
// Counts stay on the device, so drawing waits for nothing. A frame that found a buffer too small
// draws nothing; finish() of its Drawing sees that, enlarges the buffer and draws it again, so look
// at pictures after finish(). Frames may be enqueued on any streams, one after the other.
class Frame {
  public:
    enum class Keeps { nothing, tape };

    explicit Frame(Keeps keeps = Keeps::nothing);
    ~Frame();
    Frame(const Frame&) = delete;
    Frame& operator=(const Frame&) = delete;

    // Enqueues what writes the batch's items, and its tables where they are not there yet. Called
    // again when a frame is drawn again. The counters are zero before.
    using Prepare = std::function<void(const ItemList& items, cudaStream_t stream)>;

    // Says where the pictures of images without a place are. Called once, when the device has
    // something to do.
    using Place = std::function<void(PicturePlanes planes[2])>;

    // Enqueues a frame. While `stream` captures a graph nothing is allocated: draw as much once
    // before. The frame's buffers then live as long as this object.
    std::unique_ptr<Drawing> draw(const FrameBatch& batch, Prepare prepare, cudaStream_t stream,
                                  const Place& place = {});

    // Bytes of what it keeps on the device, by part.
    std::vector<std::pair<const char*, size_t>> bytes() const;

    // Of the last frame that was drawn; needs Keeps::tape.
    FrameTape tape() const;

  private:
    friend class Drawing;
    struct Slot;
    struct State;
    void enqueue(Drawing& drawing, const Place& place);
    // Of the buffers as they are now.
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
        scratch_;  // the few tiles of records, then lists that are spread
    DeviceBuffer<unsigned long long> tile_first_;
    DeviceBuffer<TilePlan> plans_;
    uint32_t num_plans_ = 0;
    DeviceBuffer<unsigned char>
        cleared_;                // State, states of the scan, zeros of items, counts of the tiles
    size_t num_zero_bytes_ = 0;  // of these, that are zero when the next frame begins

    std::vector<std::unique_ptr<Slot>> slots_;
    std::deque<Slot*> free_slots_;                // their frames may not be over yet
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

    // Waits until the device is done with it; finish() may draw it again.
    void wait() const;
    // As finish(), but the pictures may still be on their way: where the frame keeps a tape, it
    // waits no longer than until everything is counted. Not of a captured frame.
    const FrameCounters& settle();
    // Waits until the pictures are drawn, drawing again if a buffer was too small. Throws
    // OutOfMemory, or std::length_error past kMostFrameRecords.
    //
    // Of a captured frame: of its last replay, which must be over; throws std::runtime_error if a
    // buffer was too small.
    const FrameCounters& finish();
    FrameTimes times() const;
    // More than 1 where buffers were too small; known once it is finished.
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
    Capacity capacity_{};  // that it was drawn with
    PicturePlanes planes_[2]{};
    bool is_captured_ = false, is_settled_ = false;
    int num_draws_ = 1;
};

}  // namespace cuda
}  // namespace v3dg
