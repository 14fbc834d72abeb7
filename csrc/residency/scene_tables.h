#pragma once

#include <memory>
#include <vector>

#include "base/device.h"
#include "residency/bundle_tables.h"
#include "residency/instance_table.h"

namespace v3dg {
namespace cuda {

struct PoseSpan {
    Span<const double> values;
    bool is_on_device;
};

// What kernels read of a scene; everything lies on the device.
struct SceneOnDevice {
    const BundleOnDevice* bundles;
    InstanceTable instances;
};

// The bundles and the instances of a scene on the device that is current when it is made.
//
// Everything is enqueued on the stream that is passed, which belongs to that device. Several
// threads and streams take turns: whoever reads the scene on a stream holds turn() while it
// enqueues that.
class SceneTables {
  public:
    SceneTables() = default;

    // The bundles that instances name by their places in this list. Uploads no more than where
    // their tables are. What instances there are already keep their places, so a longer list that
    // begins with the last one adds bundles. Throws std::invalid_argument where tables are on
    // another device.
    void set_bundles(std::vector<std::shared_ptr<const BundleTables>> bundles, cudaStream_t stream);
    // Replaces all instances; set_poses() has to follow. Host memory may be reused on return.
    void set_instances(Span<const int32_t> bundle, Span<const float> importance,
                       cudaStream_t stream);
    // Each of the three is either the host's, which may be reused on return, or the device's, which
    // stays.
    void set_poses(const PoseSpan& position, const PoseSpan& quaternion, const PoseSpan& scale,
                   cudaStream_t stream);

    int device() const { return device_; }
    // Without the tables of the bundles, which other scenes may share.
    size_t bytes() const;
    size_t num_bundles() const { return bundles_.size(); }
    size_t num_instances() const { return num_instances_; }
    const BundleTables& bundle(size_t b) const { return *bundles_[b]; }
    size_t num_instances_of(size_t b) const { return num_instances_of_[b]; }

    SceneOnDevice on_device() const;
    StreamLock lock(cudaStream_t stream) const { return StreamLock(busy_, stream); }

  private:
    const int device_ = current_device();
    mutable StreamMutex busy_;
    std::vector<std::shared_ptr<const BundleTables>> bundles_;
    std::vector<size_t> num_instances_of_;  // each bundle
    size_t num_instances_ = 0;
    DeviceBuffer<BundleOnDevice> bundles_on_device_;
    DeviceBuffer<int32_t> bundle_;
    DeviceBuffer<float> importance_;
    DeviceBuffer<double> uploaded_[3];
    const double *position_ = nullptr, *quaternion_ = nullptr, *scale_ = nullptr;
};

}  // namespace cuda
}  // namespace v3dg
