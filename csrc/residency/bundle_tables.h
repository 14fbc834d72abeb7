#pragma once

// The tables of a bundle on a device. They are kept there while any resident scene uses
// them (v3dg/residency.py).

#include "base/device.h"
#include "residency/cluster_bounds.h"

namespace v3dg {
namespace cuda {

// The tables of a bundle that kernels read, in device memory.
struct BundleOnDevice {
    ClusterTable table;
    ClusterAppearance appearance;
    Span<const ClusterBounds> bounds;
    // One byte per ClusterBounds. Bit k is set if cluster k of the bounds can be drawn
    // together with the cluster before it. This requires adjacent rows and an equal
    // appearance.
    const uint8_t* joins;
    ClusterRuns runs;
};

// Returns BundleOnDevice::joins: one byte per kClustersOfBounds clusters.
std::vector<uint8_t> joins_of_clusters(const ClusterTable& table,
                                       const ClusterAppearance& appearance);

// The tables of one bundle, on the device that is current at construction. They are
// immutable, so all scenes, threads and streams of the device can share them. The owner
// must keep them alive until all work that reads them is done.
class BundleTables {
  public:
    // Copies the tables to the device before it returns.
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
