#pragma once

// The tables of a bundle on a device. They stay there while a scene that uses them is
// resident (v3dg/residency.py).

#include "base/device.h"
#include "residency/cluster_bounds.h"

namespace v3dg {
namespace cuda {

// The tables of a bundle that kernels read; all pointers point to device memory.
struct BundleOnDevice {
    ClusterTable table;
    ClusterAppearance appearance;
    Span<const ClusterBounds> bounds;
    // A byte per ClusterBounds. Bit k says that its cluster k is drawn together with
    // the cluster before it, because the rows of both are adjacent and their appearance
    // is equal.
    const uint8_t* joins;
    ClusterRuns runs;
};

// Returns BundleOnDevice::joins: a byte per kClustersOfBounds clusters.
std::vector<uint8_t> joins_of_clusters(const ClusterTable& table,
                                       const ClusterAppearance& appearance);

// The tables of one bundle on the device that is current when they are made. They never
// change, so all scenes, threads and streams of that device share them. The owner keeps
// them alive until all work that reads them is done.
class BundleTables {
  public:
    // Returns after the tables have arrived on the device; the host memory may then be
    // reused.
    BundleTables(const ClusterTable& table, const ClusterAppearance& appearance,
                 cudaStream_t stream);
    BundleTables(const BundleTables&) = delete;
    BundleTables& operator=(const BundleTables&) = delete;

    int device() const { return device_; }
    size_t bytes() const { return storage_.bytes(); }
    size_t num_clusters() const { return on_device_.table.num_clusters(); }
    const BundleOnDevice& on_device() const { return on_device_; }

  private:
    const int device_ = current_device();
    DeviceBuffer<unsigned char> storage_;  // memory of all arrays
    BundleOnDevice on_device_;
};

}  // namespace cuda
}  // namespace v3dg
