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

// Memory of the host that devices read and write.
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

// Frames whose cuts are under way at once; the next one waits for the first of them.
constexpr size_t kMostFlights = 4;

// Bytes that a packed row of a pool takes.
size_t packed_row_bytes(int max_sh_degree);

// Gaussians in slots: codes, or packed rows whatever the codec of their pages is. Frames read them,
// and those that come and go are brought, in the order of locks of mutex(), on any streams of the
// device.
class DevicePages {
  public:
    // `tables` are on the current device, `host` are the same on the host.
    DevicePages(PagePool& pool, std::vector<std::shared_ptr<const BundleTables>> tables,
                const std::vector<ClusterTable>& host,
                const std::vector<ClusterAppearance>& appearance, cudaStream_t stream);
    ~DevicePages();
    DevicePages(const DevicePages&) = delete;
    DevicePages& operator=(const DevicePages&) = delete;

    StreamMutex& mutex() { return busy_; }
    // Takes note of what frames needed whose cuts are over. Enqueues what brings pages in before a
    // cut, and returns what that reads. Under the lock. Waits only where kMostFlights cuts are not
    // over.
    PartlyResident begin_frame(bool is_bounded, Arrive arrive, cudaStream_t stream);
    // The cut is enqueued. Under the lock.
    void end_frame(cudaStream_t stream);
    // Takes note of what frames needed whose cuts are over, before the next one begins.
    void note_frames(cudaStream_t stream);
    // The models of all bundles, on the device: one of the two, the other is null.
    const PackedPlanes* packed() const { return packed_.data(); }
    const CodedGaussians* coded() const { return coded_.data(); }
    // What the pool says that the frame which began last is drawn with.
    SelectRule raised(SelectRule rule) const;

    // Cuts the scene without drawing, and waits until the pool has decided about what that needs.
    // `begins`: it forgets earlier frames before (PagePool::begin_settling).
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
    DeviceBuffer<int64_t> shift_;           // of all bundles
    DeviceBuffer<uint32_t> cluster_shift_;  // the same, where there are codes
    DeviceBuffer<int32_t> begins_;          // likewise, as PageTable has them
    std::vector<size_t> first_page_;        // of each bundle, among those of all
    DeviceBuffer<BundleOnDevice> bundles_;
    DeviceBuffer<uint32_t> words_;
    DeviceBuffer<uint32_t*> need_;
    DeviceBuffer<PageRequest> list_;
    size_t num_words_ = 0;
    std::vector<std::unique_ptr<Flight>> flights_;
    std::deque<Flight*> under_way_;
    Flight* current_ = nullptr;  // of the frame that is being enqueued
    Cut cut_;
};

}  // namespace cuda
}  // namespace v3dg
