#include "pipeline/frame_cuda.h"

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <string>

#include "project/project_backward.h"

namespace v3dg {
namespace cuda {

// What a frame counts, cleared before it and copied to the host after it.
struct Frame::State {
    FrameCounters counters;
    unsigned long long ticket;
};

// What the host keeps of a frame in flight.
struct Frame::Slot {
    State* state = nullptr;  // pinned
    cudaEvent_t begun = nullptr, prepared = nullptr, counted = nullptr, done = nullptr;

    Slot() {
        check(cudaMallocHost(reinterpret_cast<void**>(&state), sizeof *state), "cudaMallocHost");
        *state = State{};
        for (cudaEvent_t* event : {&begun, &prepared, &counted, &done})
            check(cudaEventCreate(event), "cudaEventCreate");
    }
    ~Slot() {
        // At exit the driver may be gone before us.
        for (const cudaEvent_t event : {begun, prepared, counted, done})
            if (event != nullptr) cudaEventDestroy(event);
        cudaFreeHost(state);
        cudaGetLastError();
    }
};

// So many frames can be in flight, or be captured, without a new slot.
constexpr size_t kSlots = 8;

Frame::Frame(Keeps keeps) : keeps_(keeps) {
    for (size_t i = 0; i < kSlots; ++i) slots_.push_back(std::make_unique<Slot>());
    for (const auto& slot : slots_) free_slots_.push_back(slot.get());
}

Frame::~Frame() = default;

template <class T>
T* Frame::room(DeviceBuffer<T>& buffer, size_t size, const Drawing& drawing) {
    if (size > buffer.capacity() && was_captured_ && !drawing.is_captured_)
        retired_.push_back(std::make_shared<DeviceBuffer<T>>(std::move(buffer)));
    return buffer.reserve(size, drawing.stream_);
}

Frame::Slot* Frame::take_slot(bool capturing) {
    // The oldest is the first to be over. A capture may not ask; nobody draws beside one.
    const bool waits =
        !free_slots_.empty() && !capturing && cudaEventQuery(free_slots_.front()->done) != cudaSuccess;
    if (free_slots_.empty() || waits) {
        cudaGetLastError();
        if (capturing)
            throw std::runtime_error("frame: expected at most " + std::to_string(kSlots) +
                                     " frames in flight or captured");
        slots_.push_back(std::make_unique<Slot>());
        return slots_.back().get();
    }
    Slot* slot = free_slots_.front();
    free_slots_.pop_front();
    return slot;
}

void Frame::enlarge(const State& s) {
    if (s.counters.gaussians > kMostFrameRecords)
        throw std::length_error("gaussians: expected at most " + std::to_string(kMostFrameRecords) +
                                " in one frame, got " + std::to_string(s.counters.gaussians));
    // Some more, so that a camera on its way does not need a little more every frame.
    const auto grow = [](unsigned long long& capacity, unsigned long long count) {
        if (count > capacity) capacity = count + count / 8;
    };
    // What was not projected has no entries yet; most scenes have one or two a gaussian.
    if (s.counters.gaussians > capacity_.records) grow(capacity_.entries, s.counters.gaussians);
    grow(capacity_.items, s.counters.items);
    grow(capacity_.records, s.counters.gaussians);
    grow(capacity_.large, s.counters.large);
    grow(capacity_.entries, s.counters.entries);
    capacity_.records = std::min(capacity_.records, kMostFrameRecords);
    if (was_captured_) return;
    // The largest buffers go before larger ones come, and not into the pool: pieces of the old size are of no
    // use.
    records_ = {};
    entries_ = {};
    scratch_ = {};
    trim_pool(last_stream_);
}

std::unique_ptr<Drawing> Frame::draw(const FrameBatch& batch, Prepare prepare, cudaStream_t stream) {
    std::unique_ptr<Drawing> drawing(new Drawing(*this, batch, std::move(prepare), stream));
    drawing->is_captured_ = is_capturing(stream);
    was_captured_ = was_captured_ || drawing->is_captured_;
    drawing->slot_ = take_slot(drawing->is_captured_);
    // If the frame before is over and was too large, this one is likely to be, too.
    if (last_ != nullptr && !last_->is_captured_ && !drawing->is_captured_) {
        const cudaError_t over = cudaEventQuery(last_->slot_->done);
        if (over == cudaSuccess && !last_->was_drawn()) enlarge(*last_->slot_->state);
        if (over != cudaSuccess && over != cudaErrorNotReady) check(over, "a frame");
    }
    enqueue(*drawing);
    last_ = drawing.get();
    return drawing;
}

void Frame::enqueue(Drawing& drawing) {
    const cudaStream_t stream = drawing.stream_;
    const FrameBatch& batch = drawing.batch_;
    const Slot& slot = *drawing.slot_;
    const bool capturing = drawing.is_captured_;
    const Capacity& capacity = drawing.capacity_ = capacity_;
    const StreamLock lock(busy_, stream);

    const size_t parts = tile_bin_parts(batch.num_tiles);
    const size_t cleared_bytes =
        sizeof(State) + parts * sizeof(unsigned long long) + batch.num_tiles * sizeof(uint32_t);
    unsigned char* cleared = room(cleared_, cleared_bytes, drawing);
    State* state = reinterpret_cast<State*>(cleared);
    auto* scan_state = reinterpret_cast<unsigned long long*>(cleared + sizeof(State));
    const TileCounts tiles{reinterpret_cast<uint32_t*>(scan_state + parts),
                           reinterpret_cast<unsigned*>(&state->ticket), scan_state};
    const ItemList items{room(items_, capacity.items, drawing), &state->counters, capacity.items,
                         capacity.records};
    Record<float>* records = room(records_, capacity.records, drawing);
    uint32_t* item_records = room(item_records_, capacity.items, drawing);
    ItemTiles* item_tiles = room(item_tiles_, capacity.items, drawing);
    LargeRecord* large = room(large_, capacity.large, drawing);
    TileEntry* entries = room(entries_, capacity.entries, drawing);
    // The blend stage overwrites the tiles of records over few tiles, which have all been read by then.
    FewTiles* few = room(scratch_, std::max(capacity.records, capacity.entries), drawing);
    const bool keeps_tape = keeps_ == Keeps::tape;
    uint32_t* source = keeps_tape ? room(source_, capacity.records, drawing) : nullptr;
    const TileBinOutput bins{room(tile_first_, batch.num_tiles + 1, drawing),
                             room(image_of_tile_, batch.num_tiles, drawing), entries};

    if (!capturing) check(cudaEventRecord(slot.begun, stream), "cudaEventRecord");
    check(cudaMemsetAsync(cleared, 0, cleared_bytes, stream), "cudaMemsetAsync");
    drawing.prepare_(items, stream);
    if (!capturing) check(cudaEventRecord(slot.prepared, stream), "cudaEventRecord");
    project({batch.models, batch.packed, batch.coded, batch.placements, batch.images, items,
             batch.has_shared_items, batch.has_faded_items},
            {records, few, item_records, item_tiles, source, tiles, large, capacity.large}, stream);
    tile_bin({item_tiles, few, records, batch.images, batch.num_images, batch.num_tiles, capacity, large,
              tiles, &state->counters},
             bins, stream);
    num_plans_ = keeps_tape ? batch.num_tiles : most_plans(batch.num_tiles);
    room(plans_, num_plans_, drawing);
    const RasterTape tape{keeps_tape ? room(order_, capacity.entries, drawing) : nullptr,
                          keeps_tape ? room(blended_, batch.num_tiles, drawing) : nullptr};
    const auto report = [&] {
        check(cudaMemcpyAsync(slot.state, state, sizeof *state, cudaMemcpyDeviceToHost, stream),
              "cudaMemcpyAsync to the host");
        if (!capturing) check(cudaEventRecord(slot.counted, stream), "cudaEventRecord");
    };
    // Whoever differentiates goes on while the pictures are blended; else nothing should delay the blending.
    if (keeps_tape) {
        place_slots(items, item_records, records, room(first_slot_, capacity.records, drawing), stream);
        report();
    }
    rasterize(lists(batch), keeps_tape ? &tape : nullptr, stream);
    if (!keeps_tape) report();
    if (!capturing) check(cudaEventRecord(slot.done, stream), "cudaEventRecord");
    last_stream_ = stream;
    last_batch_ = batch;
}

FrameLists Frame::lists(const FrameBatch& batch) const {
    return {batch.images,
            image_of_tile_.data(),
            batch.num_tiles,
            records_.data(),
            tile_first_.data(),
            entries_.data(),
            reinterpret_cast<TileEntry*>(scratch_.data()),
            &reinterpret_cast<const State*>(cleared_.data())->counters,
            capacity_,
            plans_.data(),
            num_plans_,
            batch.min_transmittance};
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
    if (frame_.last_ == this) frame_.last_ = nullptr;
    // A graph goes on writing to its slot.
    if (slot_ != nullptr && !is_captured_) frame_.free_slots_.push_back(slot_);
}

bool Drawing::was_drawn() const { return capacity_.holds(slot_->state->counters); }

void Drawing::wait() const {
    if (!is_captured_) check(cudaEventSynchronize(slot_->done), "a frame");
}

const FrameCounters& Drawing::finish() {
    if (is_captured_) {
        if (!was_drawn())
            throw std::runtime_error(
                "frame: a captured graph met more than it has room for; draw once outside of the capture "
                "what it will meet, and capture it again");
        return slot_->state->counters;
    }
    settle();
    wait();
    return slot_->state->counters;
}

const FrameCounters& Drawing::settle() {
    while (!is_settled_) {
        check(cudaEventSynchronize(slot_->counted), "a frame");
        is_settled_ = was_drawn();
        if (is_settled_) break;
        frame_.enlarge(*slot_->state);
        std::optional<StreamLock> lock;
        if (batch_.guards_models != nullptr) lock.emplace(*batch_.guards_models, stream_);
        frame_.enqueue(*this);
    }
    return slot_->state->counters;
}

FrameTimes Drawing::times() const {
    FrameTimes times{0.0f, 0.0f};
    if (is_captured_) return times;
    check(cudaEventElapsedTime(&times.prepare_ms, slot_->begun, slot_->prepared), "cudaEventElapsedTime");
    check(cudaEventElapsedTime(&times.draw_ms, slot_->prepared, slot_->done), "cudaEventElapsedTime");
    return times;
}

}  // namespace cuda
}  // namespace v3dg
