#pragma once

// The device memory of a page pool: slots that hold pages of gaussians on CUDA.

#include <deque>
#include <memory>
#include <vector>

#include "project/project_cuda.h"
#include "residency/page_pool.h"
#include "select/select_cuda.h"

namespace v3dg {
namespace cuda {

// Frees pinned host memory, which devices can access.
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

// Maximum number of frames whose cuts are in progress on the device. The next frame
// waits for the oldest cut.
constexpr size_t kMostFlights = 4;

// Returns the bytes of a packed row in a pool.
size_t packed_row_bytes(int max_sh_degree);

// The gaussians in the slots of a pool, either as codes or as packed rows. Pages of any
// codec can be packed. While mutex() is locked, frames may read the slots and page
// changes may write them, on any stream of the device. The device processes this work
// in the order in which the mutex was locked.
class DevicePages {
  public:
    // `tables` are on the current device, and `host` are copies in host memory.
    DevicePages(PagePool& pool, std::vector<std::shared_ptr<const BundleTables>> tables,
                const std::vector<ClusterTable>& host,
                const std::vector<ClusterAppearance>& appearance, cudaStream_t stream);
    ~DevicePages();
    DevicePages(const DevicePages&) = delete;
    DevicePages& operator=(const DevicePages&) = delete;

    StreamMutex& mutex() { return busy_; }
    // Starts a frame: passes the page requests of finished cuts to the pool, enqueues
    // the copies of arriving pages, and returns the tables for the frame's cut. Waits
    // only if kMostFlights cuts are in progress. The caller must have locked mutex().
    PartlyResident begin_frame(bool is_bounded, Arrive arrive, cudaStream_t stream);
    // Ends a frame. Call this after its cut is enqueued. The caller must have locked
    // mutex().
    void end_frame(cudaStream_t stream);
    // Passes the page requests of finished cuts to the pool, without starting a frame.
    void note_frames(cudaStream_t stream);
    // The models of all bundles, on the device. One of packed() and coded() is null.
    const PackedPlanes* packed() const { return packed_.data(); }
    const CodedGaussians* coded() const { return coded_.data(); }
    // Returns the rule with the tolerance that the pool has chosen for the current
    // frame.
    SelectRule raised(SelectRule rule) const;

    // Selects a cut without drawing, and waits until the pool has decided about the
    // pages that the cut requests. If `begins` is true, the pool first discards the
    // requests of earlier frames (PagePool::begin_settling).
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
    const int sh_stride_;  // floats per packed row of SH coefficients
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
    DeviceBuffer<int64_t> shift_;  // One element per page, over all bundles.
    // One element per page, over all bundles. Only used if the pool keeps codes.
    DeviceBuffer<uint32_t> cluster_shift_;
    // One element per page, over all bundles, as described at PageTable.
    DeviceBuffer<int32_t> begins_;
    // For each bundle, the index of its first page among the pages of all bundles.
    std::vector<size_t> first_page_;
    DeviceBuffer<BundleOnDevice> bundles_;
    DeviceBuffer<uint32_t> words_;
    DeviceBuffer<uint32_t*> need_;
    DeviceBuffer<PageRequest> list_;
    size_t num_words_ = 0;
    std::vector<std::unique_ptr<Flight>> flights_;
    std::deque<Flight*> under_way_;
    Flight* current_ = nullptr;  // the frame that was begun but not ended
    Cut cut_;
};

}  // namespace cuda
}  // namespace v3dg
