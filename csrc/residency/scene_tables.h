#pragma once

// The tables of a scene on a device: its bundles, and its instances with their poses.

#include <memory>
#include <vector>

#include "base/device.h"
#include "residency/bundle_tables.h"
#include "residency/environments.h"
#include "residency/instance_table.h"

namespace v3dg {
namespace cuda {

// One component of the poses of all instances: positions, quaternions or scales.
struct PoseSpan {
    Span<const double> values;
    bool is_on_device;
};

// The tables of a scene that kernels read; all pointers point to device memory.
struct SceneOnDevice {
    const BundleOnDevice* bundles;
    InstanceTable instances;
    EnvironmentTable environments;
};

// The number of clusters that a warp tests together.
constexpr size_t kClustersOfPart = 32 * kClustersOfBounds;

// Bounds on what one camera sees of a scene: its instances, and the parts of
// kClustersOfPart clusters of their tables.
struct SeenBounds {
    size_t instances, parts;
};

// The bundles and the instances of a scene on the device that is current when it is
// made.
//
// All work is enqueued on the stream that is passed, which must belong to that device.
// Several threads and streams take turns: a thread that enqueues reads of the scene on
// a stream holds lock(stream) meanwhile.
class SceneTables {
  public:
    SceneTables() = default;

    // Sets the bundles. Instances refer to them by their index in this list. Uploads
    // only pointers to the tables. Existing instances keep their indices: to add
    // bundles, pass a longer list that begins with the previous one. Throws
    // std::invalid_argument if tables are on another device.
    void set_bundles(std::vector<std::shared_ptr<const BundleTables>> bundles, cudaStream_t stream);
    // Replaces all instances; the caller must call set_poses() afterwards. The host
    // memory may be reused on return. `factors` is empty if all are 1.
    void set_instances(Span<const int32_t> bundle, Span<const float> importance,
                       Span<const InstanceFactors> factors, const EnvironmentTable& environments,
                       cudaStream_t stream);
    // Sets the poses. Each component is either in host memory, which may be reused on
    // return, or in device memory, which must stay unchanged.
    void set_poses(const PoseSpan& position, const PoseSpan& quaternion, const PoseSpan& scale,
                   cudaStream_t stream);

    int device() const { return device_; }
    // Returns the bytes on the device, without the tables of the bundles, which other
    // scenes may share.
    size_t bytes() const;
    size_t num_bundles() const { return bundles_.size(); }
    size_t num_instances() const { return num_instances_; }
    const BundleTables& bundle(size_t b) const { return *bundles_[b]; }

    // Bounds for cameras that see all instances, and for those that belong to an
    // environment.
    const SeenBounds& seen_by_all() const { return seen_by_all_; }
    const SeenBounds& seen_in_environment() const { return seen_in_environment_; }

    SceneOnDevice on_device() const;
    // Locks the scene for work that is enqueued on a stream.
    StreamLock lock(cudaStream_t stream) const { return StreamLock(busy_, stream); }

  private:
    void find_bounds(Span<const int32_t> bundle, const EnvironmentTable& environments);

    const int device_ = current_device();
    mutable StreamMutex busy_;
    std::vector<std::shared_ptr<const BundleTables>> bundles_;
    size_t num_instances_ = 0;
    DeviceBuffer<BundleOnDevice> bundles_on_device_;
    DeviceBuffer<int32_t> bundle_;
    DeviceBuffer<float> importance_;
    DeviceBuffer<InstanceFactors> factors_;
    DeviceBuffer<int32_t> environment_order_, environment_begin_;
    size_t num_environment_begins_ = 0;
    SeenBounds seen_by_all_{}, seen_in_environment_{};
    size_t num_factors_ = 0;
    DeviceBuffer<double> uploaded_[3];
    const double *position_ = nullptr, *quaternion_ = nullptr, *scale_ = nullptr;
};

}  // namespace cuda
}  // namespace v3dg
