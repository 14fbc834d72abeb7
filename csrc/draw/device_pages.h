#pragma once

// The slots of a page pool on a CUDA device.

#include <deque>
#include <memory>
#include <vector>

#include "project/project_cuda.h"
#include "residency/page_pool.h"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

// Frees memory of the host that devices can access.
struct FreePinned {
    void operator()(void* memory) const noexcept;
};
template <class T>
using Pinned = std::unique_ptr<T[], FreePinned>;

class PinnedBlocks : public BlockMemory {
  public:
    unsigned char* allocate(size_t bytes) override;

  private:
    std::vector<Pinned<unsigned char>> blocks_;
};

// The largest number of frames whose cuts are pending. The next frame waits for the
// first of them.
constexpr size_t kMostFlights = 4;

// Returns the size of a packed row in a pool.
size_t packed_row_bytes(int max_sh_degree);

// The gaussians in the slots of a pool: codes, or packed rows for pages of any codec.
// Frames read the slots and page changes write them, on any streams of the device, in
// the order in which mutex() is locked.
class DevicePages {
  public:
    // `tables` are on the current device, `host` has the same tables on the host.
    DevicePages(PagePool& pool, std::vector<std::shared_ptr<const BundleTables>> tables,
                const std::vector<ClusterTable>& host,
                const std::vector<ClusterAppearance>& appearance, cudaStream_t stream);
    ~DevicePages();
    DevicePages(const DevicePages&) = delete;
    DevicePages& operator=(const DevicePages&) = delete;

    StreamMutex& mutex() { return busy_; }
    // Notes the needs of frames whose cuts are done. Enqueues the copies of arriving
    // pages, which precede the cut, and returns the tables that the cut reads. Requires
    // the lock. Waits only if kMostFlights cuts are pending.
    PartlyResident begin_frame(bool is_bounded, Arrive arrive, cudaStream_t stream);
    // Called after the cut was enqueued. Requires the lock.
    void end_frame(cudaStream_t stream);
    // Notes the needs of frames whose cuts are done, without beginning a new frame.
    void note_frames(cudaStream_t stream);
    // The models of all bundles, on the device. One of the two is null.
    const PackedPlanes* packed() const { return packed_.data(); }
    const CodedGaussians* coded() const { return coded_.data(); }
    // Returns the rule with the tolerance that the pool requires for the frame that
    // began last.
    SelectRule raised(SelectRule rule) const;

    // Cuts the scene without drawing, and waits until the pool has decided about the
    // needs of the cut. With `begins`, the pool first forgets earlier frames
    // (PagePool::begin_settling).
    SettlingStep settle_step(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                             bool begins, cudaStream_t stream);

  private:
    struct Flight;
    void make_packed(cudaStream_t stream);
    void make_coded(cudaStream_t stream);
    void make_tables(const std::vector<ClusterTable>& host,
                     const std::vector<ClusterAppearance>& appearance, cudaStream_t stream);
    NotedView note_flights(bool waits);
    void measure(const Flight& flight);
    Flight& free_flight();
    const int64_t* offset_on_device(const PageChange& change) const;
    PageRows page_rows(const PageChange& change, const unsigned char* bytes) const;
    SlotPage slot_page(const PageChange& change, const unsigned char* bytes) const;
    void bring(const std::vector<PageChange>& changes, Flight& flight, cudaStream_t stream);
    void note_arrivals(Flight& flight, cudaStream_t stream);

    PagePool& pool_;
    const std::vector<std::shared_ptr<const BundleTables>> tables_;
    const int sh_stride_;  // of packed rows
    StreamMutex busy_;
    DeviceBuffer<float> rows_, sh_;
    DeviceBuffer<PackedPlanes> packed_;
    DeviceBuffer<uint32_t> records_, sh_codes_;
    DeviceBuffer<unsigned char> ranges_;
    DeviceBuffer<int64_t> offset_;
    CodeSlots slots_{};
    DeviceBuffer<CodedGaussians> coded_;
    DeviceBuffer<unsigned char> staged_;
    DeviceBuffer<uint8_t> joins_;
    DeviceBuffer<int64_t> shift_;           // of the pages of all bundles
    DeviceBuffer<uint32_t> cluster_shift_;  // likewise, in a pool that keeps codes
    DeviceBuffer<int32_t> begins_;          // likewise; see PageTable
    std::vector<size_t> first_page_;        // index of each bundle's first page among all pages
    DeviceBuffer<BundleOnDevice> bundles_;
    DeviceBuffer<uint32_t> words_;
    DeviceBuffer<uint32_t*> need_;
    DeviceBuffer<PageRequest> list_;
    size_t num_words_ = 0;
    std::vector<std::unique_ptr<Flight>> flights_;
    std::deque<Flight*> under_way_;
    Flight* current_ = nullptr;  // the frame that is being enqueued
    Cut cut_;
};

}  // namespace cuda
}  // namespace v3dg
