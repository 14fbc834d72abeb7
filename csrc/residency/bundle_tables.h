#pragma once

// The tables of a bundle on a device. They live as long as a scene that uses them is resident there
// (v3dg/residency.py).

#include "base/device.h"
#include "residency/cluster_bounds.h"

namespace v3dg {
namespace cuda {

// What kernels read of a bundle; all pointers point to memory of the device.
struct BundleOnDevice {
    ClusterTable table;
    ClusterAppearance appearance;
    Span<const ClusterBounds> bounds;
    // A byte for each ClusterBounds. Bit k: its cluster k is drawn together with the cluster before
    // it, since its rows follow and it has the same appearance.
    const uint8_t* joins;
    ClusterRuns runs;
};

// Returns BundleOnDevice::joins: a byte for each kClustersOfBounds clusters.
std::vector<uint8_t> joins_of_clusters(const ClusterTable& table,
                                       const ClusterAppearance& appearance);

// The tables of one bundle on the device that is current when they are made. They never change, so
// all scenes, threads and streams of that device share them. They have to outlive the work that
// reads them.
class BundleTables {
  public:
    // Returns when the tables are on the device; the memory of the host may be reused then.
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
    DeviceBuffer<unsigned char> storage_;  // of all arrays
    BundleOnDevice on_device_;
};

}  // namespace cuda
}  // namespace v3dg
