#pragma once

// The tables of a bundle on a device. They live as long as a scene that v3dg/residency.py keeps
// there has them.

#include "base/device.h"
#include "residency/cluster_bounds.h"

namespace v3dg {
namespace cuda {

// What kernels read of a bundle; all that it points to lies on the device.
struct BundleOnDevice {
    ClusterTable table;
    ClusterAppearance appearance;
    Span<const ClusterBounds> bounds;
    // A byte for each of the bounds; bit k: its cluster k is drawn together with the one before,
    // since its rows follow and it looks the same.
    const uint8_t* joins;
    ClusterRuns runs;
};

// A byte for each kClustersOfBounds clusters, as BundleOnDevice::joins has them.
std::vector<uint8_t> joins_of_clusters(const ClusterTable& table,
                                       const ClusterAppearance& appearance);

// The tables of one bundle on the device that is current when they are made. They never change, so
// the scenes, threads and streams of that device share them. They have to outlive the work that
// reads them.
class BundleTables {
  public:
    // Returns when the tables are on the device; the host's memory may then be reused.
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
