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

// Bytes that a row of a pool takes.
size_t pooled_row_bytes(int max_sh_degree);

// Gaussians in slots, packed whatever the codec of their pages is. Frames read them, and those that come and
// go are brought, in the order of locks of mutex(), on any streams of the device.
class DevicePages {
  public:
    // `tables` are on the current device, `host` are the same on the host.
    DevicePages(PagePool& pool, std::vector<std::shared_ptr<const BundleTables>> tables,
                const std::vector<ClusterTable>& host, const std::vector<ClusterAppearance>& appearance,
                size_t num_rows, cudaStream_t stream);
    ~DevicePages();
    DevicePages(const DevicePages&) = delete;
    DevicePages& operator=(const DevicePages&) = delete;

    StreamMutex& mutex() { return busy_; }
    // Takes note of what frames needed whose cuts are over. Enqueues what brings pages in before a cut, and
    // returns what that reads. Under the lock. Waits only where kMostFlights cuts are not over.
    PartlyResident begin_frame(bool is_bounded, cudaStream_t stream);
    // The cut is enqueued. Under the lock.
    void end_frame(cudaStream_t stream);
    // Takes note of what frames needed whose cuts are over, before the next one begins.
    void note_frames(cudaStream_t stream);
    // Of the models of all bundles, on the device.
    const PackedPlanes* planes() const { return planes_on_device_.data(); }
    // What the pool says that a frame may be drawn with.
    SelectRule raised(SelectRule rule) const;

    // Cuts the scene without drawing, and waits for what that needs; the tolerance that was used.
    float ask(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule, cudaStream_t stream);

  private:
    struct Flight;
    void note_flights(bool waits);
    void measure(const Flight& flight);
    Flight& free_flight();
    void bring(const std::vector<PageChange>& changes, Flight& flight, cudaStream_t stream);

    PagePool& pool_;
    const std::vector<std::shared_ptr<const BundleTables>> tables_;
    const size_t num_rows_;
    const int sh_stride_;
    StreamMutex busy_;
    DeviceBuffer<float> rows_, sh_;
    DeviceBuffer<PackedPlanes> planes_on_device_;
    DeviceBuffer<unsigned char> staged_;
    DeviceBuffer<uint8_t> joins_;
    DeviceBuffer<int64_t> shift_;  // of all bundles
    std::vector<int64_t*> shift_of_bundle_;
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
