#pragma once

// Frames on a CUDA device: from the items of a frame to pixels.

#include <deque>
#include <functional>
#include <memory>
#include <utility>
#include <vector>

#include "base/device.h"
#include "base/mapped_memory.h"
#include "draw/sensed_records.h"
#include "frame/tile_list.h"
#include "project/project_cuda.h"
#include "rasterize/rasterize.h"
#include "tile_bin/tile_bin.h"

namespace v3dg {
namespace cuda {

// The input of a frame. Its device memory must not change until the frame is drawn.
struct FrameBatch {
    const GaussianRows<const float>* models;
    const Placement* placements;
    const FrameImage* images;
    uint32_t num_images, num_tiles;  // `num_tiles`: total over all images
    // Packed and coded models (see ProjectInput).
    const PackedPlanes* packed = nullptr;
    const CodedGaussians* coded = nullptr;
    // Whether any item may be shared by several placements. Must be false with a tape.
    bool has_shared_items = false;
    // The transmittance at which pixels of all images stop. kStopsByCut is only allowed
    // with a budget.
    float min_transmittance = kStopsBefore;
    // Whether any item may have a weight below 1. Such items occur only in scenes, and
    // are never shared.
    bool has_faded_items = false;
    bool has_lenses = false;  // whether the camera of any image is not a pinhole
    // [num_factors] as in ProjectInput; may be null
    const InstanceFactors* factors = nullptr;
    uint32_t num_factors = 0;
    // The mutex that guards the models, or null if they never change between frames.
    // The caller must hold it during draw().
    StreamMutex* guards_models = nullptr;
    size_t num_zeros = 0;  // size of ItemList::zeros
    // Whether depth is drawn in the images whose destination is set by a Place.
    bool has_depth = true;
    ImageCounts* image_counts = nullptr;  // as in ProjectInput
    // Whether images are filled with NaN if they are not drawn because a buffer is too
    // small. If so, all images must have planes.
    bool marks_undrawn = false;
    // Channels and meshes of the images, and the scene that the channels show.
    FrameSensors sensors = {};
    SensedScene sensed_scene = {};
};

// The results of a frame that its backward pass needs. They are valid until the next
// frame is drawn.
struct FrameTape {
    FrameLists lists;
    RasterTape raster;
    const GaussianRows<const float>* models;
    const Placement* placements;
    const DrawItem* items;         // counters->items elements
    const uint32_t* item_records;  // number of records of each item
    const uint32_t* source;        // index of each record's gaussian in its model
    // First gradient slot of each record, written by place_slots().
    const uint32_t* first_slot;
};

struct FrameTimes {
    float prepare_ms, draw_ms;
};

class Drawing;

// Draws batches of pictures: projects, bins and blends the gaussians. The buffers are
// reused from frame to frame.
//
// Counts stay on the device, so draw() does not wait. If a buffer turns out to be too
// small, nothing is drawn. Drawing::finish() then enlarges the buffers and draws again,
// so pictures must not be read before finish(). Frames may use different streams, but
// only one thread may call draw() at a time.
class Frame {
  public:
    enum class Keeps { nothing, tape };

    explicit Frame(Keeps keeps = Keeps::nothing);
    ~Frame();
    Frame(const Frame&) = delete;
    Frame& operator=(const Frame&) = delete;

    // A function that enqueues the work that writes the batch's items and any tables
    // that are still missing. It is called again each time the frame is drawn again.
    // All counters are zero before that work runs.
    using Prepare = std::function<void(const ItemList& items, cudaStream_t stream)>;

    // A function that sets the destinations of images that have none. It is called
    // once, after the first work is enqueued.
    using Place = std::function<void(PicturePlanes planes[2])>;

    // Enqueues a frame. While `stream` captures a graph, nothing can be allocated, so a
    // frame of the same size must be drawn before the capture. The buffers of a
    // captured frame are kept until this object is destroyed.
    std::unique_ptr<Drawing> draw(const FrameBatch& batch, Prepare prepare, cudaStream_t stream,
                                  const Place& place = {});

    // Returns the device memory in bytes, one entry per purpose.
    std::vector<std::pair<const char*, size_t>> bytes() const;

    // Frees the buffers, to make room for a smaller frame. Does nothing if a graph was
    // captured, because the graph may still use the buffers.
    void release_buffers();

    // Returns the tape of the last frame. Precondition: the frame keeps a tape.
    FrameTape tape() const;

  private:
    friend class Drawing;
    struct Slot;
    struct State;
    void enqueue(Drawing& drawing, const Place& place);
    // Enqueues the sensor pass. `source` is as in ProjectOutput; it may be null if no
    // channel needs it.
    void sense(const Drawing& drawing, const FrameLists& lists, const RasterTape& tape,
               const ItemList& items, const uint32_t* source);
    void sense_scene(const Drawing& drawing, const FrameLists& lists, const RasterTape& tape,
                     const ItemList& items, const uint32_t* source, const SceneOnDevice& scene);
    // Returns the lists in the current buffers.
    FrameLists lists(const FrameBatch& batch) const;
    RecordPlanes records() const;
    // Enlarges the buffers if an earlier, finished frame exceeded or nearly filled one,
    // because the next frame would probably exceed it. The Drawing of that frame may be
    // destroyed already.
    void check_counts();
    void enlarge(const FrameCounters& counters);
    Slot* take_slot(bool capturing);
    template <class T>
    T* room(DeviceBuffer<T>& buffer, size_t size, const Drawing& drawing);
    template <class T>
    T* room(GrowingBuffer<T>& buffer, size_t size, const Drawing& drawing);
    // Frees the large buffers.
    void release_large_buffers();
    // Waits for the device if freeing the buffers unmaps memory that it may still use.
    void wait_before_unmapping() const;

    const Keeps keeps_;
    // Whether the large buffers grow in place. With a tape they do not, because other
    // streams may still read the tape when its frame is destroyed.
    const bool grows_in_place_;
    static constexpr Capacity kFirstCapacity{64, 4096, 4096, 4096, 4096};
    Capacity capacity_ = kFirstCapacity;
    DeviceBuffer<DrawItem> items_;
    DeviceBuffer<uint32_t> item_records_, source_, first_slot_, image_of_tile_, order_, blended_;
    // Normals and instances of records, for the sensor pass.
    DeviceBuffer<float> normals_;
    DeviceBuffer<int32_t> instances_;
    DeviceBuffer<ItemTiles> item_tiles_;
    // Large buffers, which are enlarged together.
    GrowingBuffer<float> records_;
    DeviceBuffer<RecordBox> boxes_;  // only used with a tape
    GrowingBuffer<LargeRecord> large_;
    GrowingBuffer<TileEntry> entries_;
    GrowingBuffer<unsigned long long> scratch_;  // tile lists of small records, later spread lists
    DeviceBuffer<unsigned long long> tile_first_;
    DeviceBuffer<TilePlan> plans_;
    uint32_t num_plans_ = 0;
    // Memory that is cleared: state, scan state, zeros for items, tile counts.
    DeviceBuffer<unsigned char> cleared_;
    // Number of bytes at the beginning of `cleared_` that are zero when the next frame
    // starts.
    size_t num_zero_bytes_ = 0;

    std::vector<std::unique_ptr<Slot>> slots_;
    // Slots that can be reused. The device may still be drawing their frames.
    std::deque<Slot*> free_slots_;
    // Buffers that captured graphs may still use.
    std::vector<std::shared_ptr<void>> retired_;
    bool was_captured_ = false;
    // Slots of frames whose counts have not been compared with the buffers yet.
    std::vector<Slot*> unchecked_;
    FrameBatch last_batch_{};
    cudaStream_t last_stream_ = nullptr;
    StreamMutex busy_;
};

// A frame that was enqueued. It must be destroyed before its Frame.
class Drawing {
  public:
    ~Drawing();
    Drawing(const Drawing&) = delete;
    Drawing& operator=(const Drawing&) = delete;

    // Waits until the device has finished. The picture may still be missing: if a
    // buffer was too small, finish() draws again.
    void wait() const;
    // Like finish(), but returns as soon as the buffers are known to suffice. With a
    // tape, the pictures may then still be in progress. Must not be called for a
    // captured frame.
    const FrameCounters& settle();
    // Waits until the pictures are drawn. If a buffer was too small, draws again.
    // Throws OutOfMemory, or std::length_error if there are more than kMostFrameRecords
    // records.
    //
    // For a captured frame, returns the counters of the last replay, which must have
    // ended. Throws std::runtime_error if a buffer was too small for that replay.
    const FrameCounters& finish();
    // Waits for the device, and returns whether the frame was drawn. If not, enlarges
    // the buffer that was too small, so that the caller can draw a new frame. Throws
    // like finish(). Must not be called for a captured frame.
    bool finish_or_enlarge();
    bool is_captured() const { return is_captured_; }
    FrameTimes times() const;
    // Returns how often the frame was drawn. It is drawn more than once if a buffer was
    // too small. Valid after finish().
    int num_draws() const { return num_draws_; }

  private:
    friend class Frame;
    Drawing(Frame& frame, const FrameBatch& batch, Frame::Prepare prepare, cudaStream_t stream);
    bool was_drawn() const;
    // Enlarges the buffers that were too small for this frame.
    void enlarge_frame();

    Frame& frame_;
    FrameBatch batch_;
    Frame::Prepare prepare_;
    cudaStream_t stream_;
    Frame::Slot* slot_ = nullptr;
    Capacity capacity_{};  // capacity of the buffers when the frame was enqueued
    PicturePlanes planes_[2]{};
    bool is_captured_ = false, is_settled_ = false;
    int num_draws_ = 1;
};

}  // namespace cuda
}  // namespace v3dg
