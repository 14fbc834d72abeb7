// Implements device_pages.h. Before a cut, the bytes of arriving pages are copied to
// the device, where kernels unpack them or move them to their slots. After the cut, the
// page requests are copied to the host. A Flight holds the host memory of both
// transfers.

#include "draw/device_pages.h"

#include <algorithm>
#include <stdexcept>
#include <string>
#include <utility>

#include "base/launch.cuh"

namespace v3dg {
namespace cuda {

namespace {

// A frame copies at most as many bytes as can be copied in kBringMs, and may always
// copy kLeastBytesAFrame. The speed of copying is measured on frames that copy at least
// kLeastMeasured bytes.
constexpr float kBringMs = 2.0f;
constexpr size_t kLeastMeasured = size_t(4) << 20, kLeastBytesAFrame = size_t(8) << 20;

// A page to copy from host memory to the device, and the entries of the page table to
// set afterwards. One block of threads copies the page.
struct PageMove {
    const uint4* from;
    uint4* to;
    size_t num_vectors;
    int64_t *shift, shift_value;
    uint32_t *cluster_shift, cluster_value;  // `cluster_shift` may be null
};

// Launched with one block per page. The kernel reads host memory directly, so that a
// single launch copies all pages.
__global__ void move_kernel(const PageMove* moves) {
    const PageMove move = moves[blockIdx.x];
    for (size_t i = threadIdx.x; i < move.num_vectors; i += blockDim.x) move.to[i] = move.from[i];
    if (threadIdx.x != 0) return;
    *move.shift = move.shift_value;
    if (move.cluster_shift != nullptr) *move.cluster_shift = move.cluster_value;
}

// Launched with one thread per page whose fade starts or ends.
__global__ void arrivals_kernel(const Arrival* arrivals, unsigned count, int32_t* begins) {
    const unsigned i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < count) begins[arrivals[i].page] = arrivals[i].begins;
}

template <class T>
Pinned<T> pinned(size_t count) {
    void* memory = nullptr;
    const size_t bytes = std::max<size_t>(count, 1) * sizeof(T);
    const cudaError_t error = cudaMallocHost(&memory, bytes);
    if (error == cudaErrorMemoryAllocation) {
        cudaGetLastError();
        throw OutOfMemory("cuda: out of memory: the host has no " + std::to_string(bytes) +
                          " bytes of pinned memory");
    }
    check(error, "cudaMallocHost");
    return Pinned<T>(static_cast<T*>(memory));
}

// Returns the number of floats per row of SH coefficients. A row does not include the
// coefficients of degree 0, which are in the planes. Rows are aligned to 16 bytes.
int stride_of(int sh_degree) {
    return sh_degree == 0 ? 0 : (3 * num_sh_bases(sh_degree) + 3) / 4 * 4;
}

}  // namespace

void FreePinned::operator()(void* memory) const noexcept {
    if (cudaFreeHost(memory) != cudaSuccess)
        // Ignore errors, because at exit the driver may be unloaded before this object
        // is destroyed.
        cudaGetLastError();
}

unsigned char* PinnedBlocks::allocate(size_t bytes) {
    return blocks_.emplace_back(pinned<unsigned char>(bytes)).get();
}

size_t packed_row_bytes(int max_sh_degree) {
    return sizeof(float) * (16 + static_cast<size_t>(stride_of(max_sh_degree)));
}

// The pinned host memory of a frame. It must not be reused until the frame's cut is
// finished.
struct DevicePages::Flight {
    const Pinned<PageMove> moves;
    const Pinned<PageRows> rows;  // pages to unpack, used if the pool keeps rows
    const Pinned<SlotPage> codes;
    const Pinned<Arrival> arrivals;
    const Pinned<NeedsReport> report;
    FrameNeeds* needs = nullptr;
    std::vector<unsigned char*> blocks;  // host memory that `moves` reads
    bool is_bounded = false;
    size_t bytes_in = 0;
    cudaEvent_t done = nullptr, begun = nullptr,
                // events before (`begun`) and after (`brought`) the copies of pages
        brought = nullptr;

    Flight(size_t most_changes, size_t most_arrivals)
        : moves(pinned<PageMove>(most_changes)),
          rows(pinned<PageRows>(most_changes)),
          codes(pinned<SlotPage>(most_changes)),
          arrivals(pinned<Arrival>(most_arrivals)),
          report(pinned<NeedsReport>(1)) {
        check(cudaEventCreateWithFlags(&done, cudaEventDisableTiming), "cudaEventCreate");
        for (cudaEvent_t* event : {&begun, &brought})
            check(cudaEventCreate(event), "cudaEventCreate");
    }
    ~Flight() {
        for (cudaEvent_t event : {done, begun, brought})
            if (event != nullptr && cudaEventDestroy(event) != cudaSuccess)
                // Ignore errors, because at exit the driver may be unloaded before this
                // object is destroyed.
                cudaGetLastError();
    }
};

DevicePages::DevicePages(PagePool& pool, std::vector<std::shared_ptr<const BundleTables>> tables,
                         const std::vector<ClusterTable>& host,
                         const std::vector<ClusterAppearance>& appearance, cudaStream_t stream)
    : pool_(pool),
      tables_(std::move(tables)),
      sh_stride_(stride_of(pool.max_sh_degree())),
      staged_(pool.most_bytes_on_their_way(), stream),
      list_(pool.most_needs(), stream) {
    if (pool.keeps_codes())
        make_coded(stream);
    else
        make_packed(stream);
    make_tables(host, appearance, stream);
    for (size_t k = 0; k < kMostFlights; ++k)
        flights_.push_back(std::make_unique<Flight>(pool.most_changes(),
                                                    pool.plan().num_slots + pool.most_changes()));
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

void DevicePages::make_packed(cudaStream_t stream) {
    const size_t num_rows = pool_.plan().num_rows();
    const float* plane = rows_.reserve(16 * num_rows, stream);
    const float* sh = sh_.reserve(static_cast<size_t>(sh_stride_) * num_rows, stream);
    std::vector<PackedPlanes> packed;
    for (uint32_t b = 0; b < tables_.size(); ++b)
        packed.push_back(
            {{plane, plane + 4 * num_rows, plane + 8 * num_rows, plane + 12 * num_rows},
             sh,
             pool_.source(b).sh_degree(),
             sh_stride_,
             {}});
    packed_.copy_from({packed.data(), packed.size()}, stream);
}

void DevicePages::make_coded(cudaStream_t stream) {
    const SlotPlan& plan = pool_.plan();
    const int sh_degree = pool_.max_sh_degree();
    const std::vector<int64_t> offset = plan.empty_offsets();
    slots_ = {records_.reserve(kRecordWords * plan.num_rows(), stream),
              sh_codes_.reserve(num_sh_words(sh_degree) * plan.num_rows(), stream),
              ranges_.reserve(range_bytes(sh_degree) * plan.num_clusters(), stream),
              offset_.copy_from({offset.data(), offset.size()}, stream),
              range_bytes(sh_degree),
              static_cast<uint32_t>(sh_degree),
              plan.num_clusters()};
    std::vector<CodedGaussians> coded;
    for (uint32_t b = 0; b < tables_.size(); ++b)
        coded.push_back({slots_.codes(pool_.source(b).sh_degree()), {}});
    coded_.copy_from({coded.data(), coded.size()}, stream);
}

void DevicePages::make_tables(const std::vector<ClusterTable>& host,
                              const std::vector<ClusterAppearance>& appearance,
                              cudaStream_t stream) {
    std::vector<uint8_t> joins;
    std::vector<size_t> first_join;
    size_t num_pages = 0;
    for (size_t b = 0; b < tables_.size(); ++b) {
        ClusterTable table = host[b];
        table.pages.shift = pool_.shift(b);
        const std::vector<uint8_t> own = joins_of_clusters(table, appearance[b]);
        first_join.push_back(joins.size());
        joins.insert(joins.end(), own.begin(), own.end());
        first_page_.push_back(num_pages);
        num_pages += table.num_pages();
    }
    joins_.copy_from({joins.data(), joins.size()}, stream);
    const std::vector<int64_t> shift(num_pages, kAbsentPage);
    shift_.copy_from({shift.data(), shift.size()}, stream);
    const std::vector<int32_t>& begins = pool_.arrivals().begins();
    begins_.copy_from({begins.data(), begins.size()}, stream);
    if (pool_.keeps_codes()) cluster_shift_.reserve(num_pages, stream);
    num_words_ = 1 + num_pages;
    words_.reserve(num_words_, stream);
    std::vector<BundleOnDevice> bundles;
    std::vector<uint32_t*> need;
    for (size_t b = 0; b < tables_.size(); ++b) {
        BundleOnDevice bundle = tables_[b]->on_device();
        const size_t count = pool_.shift(b).size;
        bundle.table.pages.shift = {shift_.data() + first_page_[b], count};
        bundle.table.pages.begins = {begins_.data() + first_page_[b], count};
        if (pool_.keeps_codes())
            bundle.table.pages.cluster_shift = {cluster_shift_.data() + first_page_[b], count};
        bundle.joins = joins_.data() + first_join[b];
        bundles.push_back(bundle);
        need.push_back(words_.data() + 1 + first_page_[b]);
    }
    bundles_.copy_from({bundles.data(), bundles.size()}, stream);
    need_.copy_from({need.data(), need.size()}, stream);
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

// Wait for all streams, because frames on any of them may still read the slots. Freeing
// a buffer only waits for the stream that allocated it.
DevicePages::~DevicePages() { busy_.wait(); }

// Passes the page requests of all finished cuts to the pool, and returns the pool's
// answer to the last of them. If `waits` is true, first waits for all cuts.
NotedView DevicePages::note_flights(bool waits) {
    NotedView noted;
    while (!under_way_.empty()) {
        Flight& flight = *under_way_.front();
        if (waits) check(cudaEventSynchronize(flight.done), "a frame");
        const cudaError_t over = cudaEventQuery(flight.done);
        if (over == cudaErrorNotReady) {
            cudaGetLastError();
            return noted;
        }
        check(over, "a frame");
        measure(flight);
        pool_.give_back(flight.blocks);
        flight.blocks.clear();
        FrameNeeds* needs = std::exchange(flight.needs, nullptr);
        needs->count = std::min<size_t>(flight.report[0].count, pool_.most_needs());
        needs->num_left_out = flight.report[0].count - needs->count;
        needs->tolerance_px2 = flight.report[0].tolerance_px2;
        // A caller that waits expects a result that does not depend on earlier frames.
        // Therefore the tolerance must not adapt.
        needs->adapts = flight.is_bounded && !waits;
        noted = pool_.note_needs(needs, waits);
        under_way_.pop_front();
    }
    return noted;
}

void DevicePages::note_frames(cudaStream_t stream) {
    const StreamLock lock(busy_, stream);
    note_flights(false);
}

// Adapts the number of bytes that a frame may copy to the speed of `flight`.
void DevicePages::measure(const Flight& flight) {
    if (flight.bytes_in < kLeastMeasured) return;
    float ms = 0;
    check(cudaEventElapsedTime(&ms, flight.begun, flight.brought), "cudaEventElapsedTime");
    const double bytes = kBringMs / std::max(ms, 1e-3f) * static_cast<double>(flight.bytes_in);
    pool_.set_most_bytes_a_frame(
        std::clamp(static_cast<size_t>(bytes), kLeastBytesAFrame, staged_.capacity()));
}

DevicePages::Flight& DevicePages::free_flight() {
    const auto is_free = [&](const std::unique_ptr<Flight>& flight) {
        return std::find(under_way_.begin(), under_way_.end(), flight.get()) == under_way_.end();
    };
    return **std::find_if(flights_.begin(), flights_.end(), is_free);
}

const int64_t* DevicePages::offset_on_device(const PageChange& change) const {
    return tables_[change.bundle]->on_device().table.offset.data +
           pool_.source(change.bundle).first_cluster(change.page);
}

// Returns the rows of a page whose bytes have been copied to the device.
PageRows DevicePages::page_rows(const PageChange& change, const unsigned char* bytes) const {
    const PageSource& source = pool_.source(change.bundle);
    PageRows page{rows_of_page(bytes, source.num_rows(change.page), source.sh_degree()),
                  {},
                  static_cast<size_t>(change.row)};
    if (source.codec() == PageCodec::quantized)
        page.codes = {{offset_on_device(change), source.num_clusters(change.page) + 1},
                      reinterpret_cast<const uint32_t*>(bytes),
                      source.sh_degree()};
    return page;
}

SlotPage DevicePages::slot_page(const PageChange& change, const unsigned char* bytes) const {
    SlotPage page = pool_.slot_page(change);
    page.page.words = reinterpret_cast<const uint32_t*>(bytes);
    page.page.offset.data = offset_on_device(change);
    return page;
}

void DevicePages::bring(const std::vector<PageChange>& changes, Flight& flight,
                        cudaStream_t stream) {
    const bool keeps_codes = pool_.keeps_codes();
    size_t staged = 0, num_pages = 0;
    for (size_t k = 0; k < changes.size(); ++k) {
        const PageChange& change = changes[k];
        const size_t place = first_page_[change.bundle] + change.page;
        PageMove& move = flight.moves[k];
        move = {nullptr, nullptr, 0, shift_.data() + place, kAbsentPage, nullptr, 0};
        if (change.bytes == nullptr) continue;
        const PageSource& source = pool_.source(change.bundle);
        unsigned char* bytes = staged_.data() + staged;
        move.from = reinterpret_cast<const uint4*>(change.bytes);
        move.to = reinterpret_cast<uint4*>(bytes);
        move.num_vectors = (source.num_bytes(change.page) + sizeof(uint4) - 1) / sizeof(uint4);
        move.shift_value = change.row - source.first_row(change.page);
        staged += move.num_vectors * sizeof(uint4);
        if (keeps_codes) {
            move.cluster_shift = cluster_shift_.data() + place;
            move.cluster_value =
                static_cast<uint32_t>(change.cluster - source.first_cluster(change.page));
            flight.codes[num_pages++] = slot_page(change, bytes);
        } else {
            flight.rows[num_pages++] = page_rows(change, bytes);
        }
    }
    constexpr unsigned kThreads = 256;
    flight.bytes_in = staged;
    if (staged >= kLeastMeasured) check(cudaEventRecord(flight.begun, stream), "cudaEventRecord");
    launch("move_kernel", move_kernel, static_cast<unsigned>(changes.size()), kThreads, 0, stream,
           flight.moves.get());
    if (keeps_codes)
        write_slots(flight.codes.get(), num_pages, slots_, stream);
    else
        pack_pages(flight.rows.get(), num_pages, rows_.data(), pool_.plan().num_rows(), sh_.data(),
                   sh_stride_, stream);
    if (staged >= kLeastMeasured) check(cudaEventRecord(flight.brought, stream), "cudaEventRecord");
}

void DevicePages::note_arrivals(Flight& flight, cudaStream_t stream) {
    constexpr unsigned kThreads = 256;
    const std::vector<Arrival>& changed = pool_.arrivals().changed();
    if (changed.empty()) return;
    std::copy(changed.begin(), changed.end(), flight.arrivals.get());
    launch("arrivals_kernel", arrivals_kernel, blocks_for(changed.size(), kThreads), kThreads, 0,
           stream, flight.arrivals.get(), static_cast<unsigned>(changed.size()), begins_.data());
}

PartlyResident DevicePages::begin_frame(bool is_bounded, Arrive arrive, cudaStream_t stream) {
    if (is_capturing(stream))
        throw std::runtime_error(
            "memory: a renderer with a pool cannot be captured in a CUDA graph, because its pages "
            "change; capture a renderer without memory");
    if (under_way_.size() == kMostFlights)
        check(cudaEventSynchronize(under_way_.front()->done), "a frame");
    note_flights(false);
    if (current_ != nullptr) {  // The last frame failed before its cut was enqueued.
        check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
        pool_.give_up(std::exchange(current_->needs, nullptr));
        pool_.give_back(std::exchange(current_->blocks, {}));
    }
    Flight& flight = free_flight();
    const std::vector<PageChange>& changes = pool_.begin_frame(is_bounded, arrive);
    flight.needs = pool_.lend_needs();
    flight.is_bounded = is_bounded;
    flight.blocks = pool_.take_blocks();
    current_ = &flight;
    bring(changes, flight, stream);
    note_arrivals(flight, stream);
    return {bundles_.data(),
            {words_.data(), num_words_, need_.data(), list_.data(),
             static_cast<unsigned>(pool_.most_needs()), flight.report.get(), flight.needs->list}};
}

void DevicePages::end_frame(cudaStream_t stream) {
    check(cudaEventRecord(current_->done, stream), "cudaEventRecord");
    under_way_.push_back(std::exchange(current_, nullptr));
}

SelectRule DevicePages::raised(SelectRule rule) const {
    rule.tolerance_px2 = std::max(rule.tolerance_px2, pool_.least_tolerance_px2());
    rule.frame = pool_.arrivals().frame();
    return rule;
}

SettlingStep DevicePages::settle_step(const SceneTables& scene, const Eyes& eyes,
                                      const SelectRule& rule, bool begins, cudaStream_t stream) {
    const StreamLock lock(busy_, stream);
    note_flights(true);
    if (begins) pool_.begin_settling();
    const PartlyResident resident = begin_frame(false, Arrive::at_once, stream);
    const SelectRule used = raised(rule);
    SelectOutput out;
    cut_.select(scene, eyes, used, out, stream, &resident);
    end_frame(stream);
    const NotedView noted = note_flights(true);
    return {out.fits_budget ? out.tolerance_px2 : used.tolerance_px2, noted};
}

}  // namespace cuda
}  // namespace v3dg
