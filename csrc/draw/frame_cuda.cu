// Implements frame_cuda.h: owns the buffers of a frame, runs its stages, and draws
// again if a buffer was too small.

#include "draw/frame_cuda.h"

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <string>

#include "project/project_backward.h"
#include "rasterize/sense_math.h"

namespace v3dg {
namespace cuda {

// Device memory that is cleared before each frame: counters of results and of work.
struct Frame::State {
    FrameCounters counters;
    unsigned projected[2], scan_ticket, scattered,
        spread;  // counters from which kernels claim work
    alignas(8) uint32_t plan_counts[2 * kPlanClasses];
};

// Host memory and events of one frame in flight.
struct Frame::Slot {
    FrameCounters* counters = nullptr;  // in pinned host memory
    cudaEvent_t begun = nullptr, prepared = nullptr, counted = nullptr, done = nullptr;

    Slot() {
        check(cudaMallocHost(reinterpret_cast<void**>(&counters), sizeof *counters),
              "cudaMallocHost");
        *counters = FrameCounters{};
        for (cudaEvent_t* event : {&begun, &prepared, &counted, &done})
            check(cudaEventCreate(event), "cudaEventCreate");
    }
    ~Slot() {
        const KeepsCaptures keeps_captures;
        // Ignore errors, because at exit the driver may be unloaded before this object
        // is destroyed.
        for (const cudaEvent_t event : {begun, prepared, counted, done})
            if (event != nullptr) cudaEventDestroy(event);
        cudaFreeHost(counters);
        cudaGetLastError();
    }
};

constexpr size_t kEllipseFloats = 8,
                 // Floats per record: in RecordPlanes::ellipse, and in `ellipse` and
                 // `rest` together.
    kRecordFloats = 10;

// Number of slots that are allocated in advance. More are allocated if more frames are
// in flight or captured.
constexpr size_t kSlots = 8;

Frame::Frame(Keeps keeps)
    : keeps_(keeps),
      grows_in_place_(keeps == Keeps::nothing && MappedMemory::is_supported()),
      records_(grows_in_place_),
      large_(grows_in_place_),
      entries_(grows_in_place_),
      scratch_(grows_in_place_) {
    for (size_t i = 0; i < kSlots; ++i) slots_.push_back(std::make_unique<Slot>());
    for (const auto& slot : slots_) free_slots_.push_back(slot.get());
}

Frame::~Frame() { wait_before_unmapping(); }

void Frame::wait_before_unmapping() const {
    if (!grows_in_place_) return;
    const KeepsCaptures keeps_captures;
    busy_.wait();
}

template <class T>
T* Frame::room(DeviceBuffer<T>& buffer, size_t size, const Drawing& drawing) {
    if (size > buffer.capacity() && was_captured_ && !drawing.is_captured_)
        retired_.push_back(std::make_shared<DeviceBuffer<T>>(std::move(buffer)));
    return buffer.reserve(size, drawing.stream_);
}

template <class T>
T* Frame::room(GrowingBuffer<T>& buffer, size_t size, const Drawing& drawing) {
    const bool moves = size > buffer.capacity() && !buffer.is_in_place();
    if (moves && was_captured_ && !drawing.is_captured_)
        retired_.push_back(
            std::make_shared<GrowingBuffer<T>>(std::exchange(buffer, GrowingBuffer<T>())));
    return buffer.reserve(size, drawing.stream_);
}

Frame::Slot* Frame::take_slot(bool capturing) {
    // Frames end in order, so look at the oldest one. During a capture, events must not
    // be queried.
    const bool waits = !free_slots_.empty() && !capturing &&
                       cudaEventQuery(free_slots_.front()->done) != cudaSuccess;
    if (free_slots_.empty() || waits) {
        cudaGetLastError();
        if (capturing)
            throw std::runtime_error(
                "frame: expected at most " + std::to_string(kSlots) +
                " captured frames and frames in flight, got one more; finish one first");
        slots_.push_back(std::make_unique<Slot>());
        return slots_.back().get();
    }
    Slot* slot = free_slots_.front();
    free_slots_.pop_front();
    std::erase(unchecked_, slot);
    return slot;
}

void Frame::enlarge(const FrameCounters& counters) {
    if (counters.gaussians > kMostFrameRecords)
        throw std::length_error("gaussians: expected at most " + std::to_string(kMostFrameRecords) +
                                " in one frame, got " + std::to_string(counters.gaussians));
    // Growing a buffer by moving it takes as long as drawing several frames, and a
    // frame that exceeds a buffer is drawn twice. Therefore buffers are enlarged before
    // a moving camera exceeds them. All buffers that are nearly full grow at once, and
    // by more than the counts require. Buffers that grow in place are cheap to enlarge,
    // so they grow by less.
    const auto is_full = [](unsigned long long capacity, unsigned long long count,
                            unsigned free_part) { return count > capacity - capacity / free_part; };
    const bool grows = is_full(capacity_.items, counters.items, 32) ||
                       is_full(capacity_.records, counters.gaussians, 32) ||
                       is_full(capacity_.large, counters.large, 32) ||
                       is_full(capacity_.entries, counters.entries, 32) ||
                       is_full(capacity_.spread, counters.spread, 32);
    if (!grows) return;
    const Capacity before = capacity_;
    const unsigned part = grows_in_place_ ? 16 : 8;
    const auto grow = [is_full, part](unsigned long long& capacity, unsigned long long count) {
        if (is_full(capacity, count, part)) capacity = std::max(capacity, count + count / part);
    };
    // If the gaussians exceed their capacity, their entries were not counted. Estimate
    // one entry per gaussian, because most scenes have one or two.
    if (counters.gaussians > capacity_.records) grow(capacity_.entries, counters.gaussians);
    grow(capacity_.items, counters.items);
    grow(capacity_.records, counters.gaussians);
    grow(capacity_.large, counters.large);
    grow(capacity_.entries, counters.entries);
    grow(capacity_.spread, counters.spread);
    capacity_.records = std::min(capacity_.records, kMostFrameRecords);
    // The records' tile lists and the spread lists use the same memory.
    capacity_.spread = std::max(capacity_.spread, capacity_.records);
    // With a tape, the caller receives the counts before the lists are spread.
    // Therefore the buffer must have room for all entries.
    if (keeps_ == Keeps::tape) capacity_.spread = std::max(capacity_.spread, capacity_.entries);
    if (was_captured_ || grows_in_place_ || capacity_ == before) return;
    // Free the largest buffers before larger ones are allocated. Their memory is
    // returned to the device, because the memory pool cannot reuse blocks that are too
    // small.
    release_large_buffers();
    trim_pool(last_stream_);
}

void Frame::release_large_buffers() {
    wait_before_unmapping();
    records_.release();
    normals_ = {};
    boxes_ = {};
    large_.release();
    entries_.release();
    scratch_.release();
}

void Frame::release_buffers() {
    if (was_captured_) return;
    capacity_ = kFirstCapacity;
    items_ = {};
    item_records_ = {};
    item_tiles_ = {};
    normals_ = {};
    instances_ = {};
    source_ = {};
    order_ = {};
    release_large_buffers();
    trim_pool(last_stream_);
}

std::unique_ptr<Drawing> Frame::draw(const FrameBatch& batch, Prepare prepare, cudaStream_t stream,
                                     const Place& place) {
    std::unique_ptr<Drawing> drawing(new Drawing(*this, batch, std::move(prepare), stream));
    drawing->is_captured_ = is_capturing(stream);
    was_captured_ = was_captured_ || drawing->is_captured_;
    if (!drawing->is_captured_) check_counts();
    drawing->slot_ = take_slot(drawing->is_captured_);
    enqueue(*drawing, place);
    if (!drawing->is_captured_) unchecked_.push_back(drawing->slot_);
    return drawing;
}

void Frame::check_counts() {
    std::vector<const Slot*> done;
    std::erase_if(unchecked_, [&done](const Slot* slot) {
        const cudaError_t over = cudaEventQuery(slot->done);
        if (over == cudaErrorNotReady) {
            cudaGetLastError();
            return false;
        }
        check(over, "a frame");
        done.push_back(slot);
        return true;
    });
    for (const Slot* slot : done) enlarge(*slot->counters);
}

void Frame::enqueue(Drawing& drawing, const Place& place) {
    const cudaStream_t stream = drawing.stream_;
    const FrameBatch& batch = drawing.batch_;
    const Slot& slot = *drawing.slot_;
    const bool capturing = drawing.is_captured_;
    const Capacity& capacity = drawing.capacity_ = capacity_;
    const StreamLock lock(busy_, stream);

    const size_t parts = tile_bin_parts(batch.num_tiles);
    const size_t cleared_bytes = sizeof(State) +
                                 (parts + batch.num_zeros) * sizeof(unsigned long long) +
                                 batch.num_tiles * sizeof(uint32_t);
    if (cleared_bytes > cleared_.capacity()) num_zero_bytes_ = 0;
    unsigned char* cleared = room(cleared_, cleared_bytes, drawing);
    State* state = reinterpret_cast<State*>(cleared);
    auto* scan_state = reinterpret_cast<unsigned long long*>(cleared + sizeof(State));
    unsigned long long* zeros = scan_state + parts;
    const TileCounts tiles{.count = reinterpret_cast<uint32_t*>(zeros + batch.num_zeros),
                           .scan_ticket = &state->scan_ticket,
                           .taken = &state->scattered,
                           .state = scan_state};
    const ItemList items{.items = room(items_, capacity.items, drawing),
                         .counters = &state->counters,
                         .item_capacity = capacity.items,
                         .record_capacity = capacity.records,
                         .zeros = zeros};
    room(records_, kRecordFloats * capacity.records, drawing);
    uint32_t* item_records = room(item_records_, capacity.items, drawing);
    ItemTiles* item_tiles = room(item_tiles_, capacity.items, drawing);
    LargeRecord* large = room(large_, capacity.large, drawing);
    TileEntry* entries = room(entries_, capacity.entries, drawing);
    // The blend stage later stores spread lists in this memory. By then, the tile lists
    // of small records are no longer needed.
    FewTiles* few = room(scratch_, capacity.spread, drawing);
    const bool keeps_tape = keeps_ == Keeps::tape;
    const FrameSensors& sensors = batch.sensors;
    const bool needs_source = keeps_tape || sensors.needs_normals() || sensors.needs_instances();
    uint32_t* source = needs_source ? room(source_, capacity.records, drawing) : nullptr;
    if (needs_source) room(boxes_, capacity.records, drawing);
    const RecordPlanes planes = records();
    const TileBinOutput bins{.tile_first = room(tile_first_, batch.num_tiles + 1, drawing),
                             .image_of_tile = room(image_of_tile_, batch.num_tiles, drawing),
                             .entries = entries};

    if (!capturing) check(cudaEventRecord(slot.begun, stream), "cudaEventRecord");
    if (capturing || num_zero_bytes_ < cleared_bytes)
        check(cudaMemsetAsync(cleared, 0, cleared_bytes, stream), "cudaMemsetAsync");
    const size_t num_zero_bytes = std::max(std::exchange(num_zero_bytes_, 0), cleared_bytes);
    drawing.prepare_(items, stream);
    if (!capturing) check(cudaEventRecord(slot.prepared, stream), "cudaEventRecord");
    project({.models = batch.models,
             .packed = batch.packed,
             .coded = batch.coded,
             .placements = batch.placements,
             .images = batch.images,
             .items = items,
             .has_shared_items = batch.has_shared_items,
             .has_faded_items = batch.has_faded_items,
             .has_lenses = batch.has_lenses,
             .factors = batch.factors,
             .num_factors = batch.num_factors,
             .image_counts = batch.image_counts},
            {.records = planes,
             .few = few,
             .item_records = item_records,
             .item_tiles = item_tiles,
             .source = source,
             .tiles = tiles,
             .large = large,
             .large_capacity = capacity.large,
             .taken = state->projected},
            stream);
    tile_bin({.items = item_tiles,
              .few = few,
              .records = planes,
              .images = batch.images,
              .num_images = batch.num_images,
              .num_tiles = batch.num_tiles,
              .capacity = capacity,
              .large = large,
              .counts = tiles,
              .counters = &state->counters},
             bins, stream);
    const bool needs_order = keeps_tape || sensors.is_on();
    num_plans_ = needs_order ? batch.num_tiles : most_plans(batch.num_tiles);
    room(plans_, num_plans_, drawing);
    const RasterTape tape{needs_order ? room(order_, capacity.entries, drawing) : nullptr,
                          needs_order ? room(blended_, batch.num_tiles, drawing) : nullptr};
    FrameLists of_frame = lists(batch);
    // With a tape, copy the counts before blending, so that the caller need not wait
    // for the pictures. Without a tape, the blend kernel writes them to host memory.
    if (keeps_tape) {
        place_slots(items, item_records, planes.box, room(first_slot_, capacity.records, drawing),
                    stream);
        check(cudaMemcpyAsync(slot.counters, &state->counters, sizeof *slot.counters,
                              cudaMemcpyDeviceToHost, stream),
              "cudaMemcpyAsync to the host");
        if (!capturing) check(cudaEventRecord(slot.counted, stream), "cudaEventRecord");
    } else {
        of_frame.report = slot.counters;
    }
    if (place) place(drawing.planes_);
    of_frame.has_depth = batch.has_depth;
    of_frame.num_marked = batch.marks_undrawn ? batch.num_images : 0;
    for (int k = 0; k < 2; ++k) {
        of_frame.planes[k] = drawing.planes_[k];
        of_frame.has_depth = of_frame.has_depth || drawing.planes_[k].depth != nullptr;
    }
    rasterize(of_frame, needs_order ? &tape : nullptr, stream);
    if (sensors.is_on()) sense(drawing, of_frame, tape, items, source);
    if (!capturing) check(cudaEventRecord(slot.done, stream), "cudaEventRecord");
    last_stream_ = stream;
    last_batch_ = batch;
    // Clear the counters now, so that the next frame starts sooner. There are two
    // exceptions: a captured graph may be replayed at any time, and the backward pass
    // of a tape reads the counters.
    if (was_captured_ || keeps_tape) return;
    check(cudaMemsetAsync(cleared, 0, cleared_bytes, stream), "cudaMemsetAsync");
    num_zero_bytes_ = num_zero_bytes;
}

void Frame::sense(const Drawing& drawing, const FrameLists& lists, const RasterTape& tape,
                  const ItemList& items, const uint32_t* source) {
    const SceneTables* scene = drawing.batch_.sensed_scene.scene;
    if (scene == nullptr) {
        sense_scene(drawing, lists, tape, items, source, SceneOnDevice{});
        return;
    }
    const StreamLock lock = scene->lock(drawing.stream_);
    sense_scene(drawing, lists, tape, items, source, scene->on_device());
}

void Frame::sense_scene(const Drawing& drawing, const FrameLists& lists, const RasterTape& tape,
                        const ItemList& items, const uint32_t* source, const SceneOnDevice& scene) {
    const FrameBatch& batch = drawing.batch_;
    const FrameSensors& sensors = batch.sensors;
    const size_t num_records = drawing.capacity_.records;
    float* normals = sensors.needs_normals() ? room(normals_, 3 * num_records, drawing) : nullptr;
    int32_t* instances =
        sensors.needs_instances() ? room(instances_, num_records, drawing) : nullptr;
    if (source != nullptr)
        find_sensed_records({.items = items,
                             .item_records = item_records_.data(),
                             .source = source,
                             .placements = batch.placements,
                             .models = batch.models,
                             .packed = batch.packed,
                             .coded = batch.coded,
                             .scene = batch.sensed_scene,
                             .environments = scene.environments},
                            normals, instances, drawing.stream_);
    const int32_t* labels = scene.label.empty() ? nullptr : scene.label.data;
    cuda::sense(lists, tape, {.normal = normals, .instance = instances, .label = labels}, sensors,
                drawing.stream_);
}

FrameLists Frame::lists(const FrameBatch& batch) const {
    State* state = reinterpret_cast<State*>(cleared_.data());
    return {batch.images,
            image_of_tile_.data(),
            batch.num_tiles,
            records(),
            tile_first_.data(),
            entries_.data(),
            reinterpret_cast<TileEntry*>(scratch_.data()),
            &state->counters,
            capacity_,
            plans_.data(),
            state->plan_counts,
            &state->spread,
            num_plans_,
            batch.min_transmittance};
}

std::vector<std::pair<const char*, size_t>> Frame::bytes() const {
    const size_t tape =
        boxes_.bytes() + source_.bytes() + first_slot_.bytes() + order_.bytes() + blended_.bytes();
    return {
        {"records", records_.bytes()},
        {"entries", entries_.bytes()},
        {"scratch", scratch_.bytes()},
        {"items", items_.bytes() + item_records_.bytes() + item_tiles_.bytes()},
        {"large", large_.bytes()},
        {"tiles", tile_first_.bytes() + image_of_tile_.bytes() + plans_.bytes() + cleared_.bytes()},
        {"tape", tape},
        {"channels", normals_.bytes() + instances_.bytes()}};
}

RecordPlanes Frame::records() const {
    return {records_.data(), records_.data() + kEllipseFloats * capacity_.records, boxes_.data(),
            depth_mask_of_entries(capacity_.records)};
}

FrameTape Frame::tape() const {
    return {lists(last_batch_), {order_.data(), blended_.data()},
            last_batch_.models, last_batch_.placements,
            items_.data(),      item_records_.data(),
            source_.data(),     first_slot_.data()};
}

Drawing::Drawing(Frame& frame, const FrameBatch& batch, Frame::Prepare prepare, cudaStream_t stream)
    : frame_(frame), batch_(batch), prepare_(std::move(prepare)), stream_(stream) {}

Drawing::~Drawing() {
    // A captured graph still writes to its slot, so the slot is not reused.
    if (slot_ != nullptr && !is_captured_) frame_.free_slots_.push_back(slot_);
}

bool Drawing::was_drawn() const { return capacity_.holds(*slot_->counters); }

void Drawing::wait() const {
    if (!is_captured_) check(cudaEventSynchronize(slot_->done), "a frame");
}

const FrameCounters& Drawing::finish() {
    if (is_captured_) {
        if (!was_drawn())
            throw std::runtime_error(
                "frame: a captured graph exceeded its buffers; draw the largest frame once outside "
                "of a capture, then capture again");
        return *slot_->counters;
    }
    settle();
    wait();
    return *slot_->counters;
}

const FrameCounters& Drawing::settle() {
    const bool keeps_tape = frame_.keeps_ == Frame::Keeps::tape;
    while (!is_settled_) {
        check(cudaEventSynchronize(keeps_tape ? slot_->counted : slot_->done), "a frame");
        is_settled_ = was_drawn();
        if (is_settled_) break;
        enlarge_frame();
        std::optional<StreamLock> lock;
        if (batch_.guards_models != nullptr) lock.emplace(*batch_.guards_models, stream_);
        frame_.enqueue(*this, {});
        ++num_draws_;
    }
    return *slot_->counters;
}

bool Drawing::finish_or_enlarge() {
    wait();
    if (!was_drawn()) enlarge_frame();
    return was_drawn();
}

void Drawing::enlarge_frame() {
    // This frame reports its error itself, so the next frame must not throw for the
    // same counts.
    std::erase(frame_.unchecked_, slot_);
    frame_.enlarge(*slot_->counters);
}

FrameTimes Drawing::times() const {
    FrameTimes times{0.0f, 0.0f};
    if (is_captured_) return times;
    check(cudaEventElapsedTime(&times.prepare_ms, slot_->begun, slot_->prepared),
          "cudaEventElapsedTime");
    check(cudaEventElapsedTime(&times.draw_ms, slot_->prepared, slot_->done),
          "cudaEventElapsedTime");
    return times;
}

}  // namespace cuda
}  // namespace v3dg
