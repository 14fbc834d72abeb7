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

// The tables of a scene that kernels read, in device memory.
struct SceneOnDevice {
    const BundleOnDevice* bundles;
    InstanceTable instances;
    EnvironmentTable environments;
    Span<const int32_t> label;  // label of each instance; empty if none has one
};

// The number of clusters that a warp tests together.
constexpr size_t kClustersOfPart = 32 * kClustersOfBounds;

// Bounds on what one camera sees of a scene: the number of its instances, and the
// number of parts of kClustersOfPart clusters in their tables.
struct SeenBounds {
    size_t instances, parts;
};

// The bundles and instances of a scene, on the device that is current at construction.
//
// Work is enqueued on the stream that is passed, which must belong to the device. A
// thread that enqueues work which reads the scene must hold lock(stream) while it does
// so. The lock orders the work of different threads and streams.
class SceneTables {
  public:
    SceneTables() = default;

    // Sets the bundles. An instance refers to a bundle by its index in the list. Only
    // pointers to the tables are copied to the device. Existing instances keep their
    // indices, so pass a longer list that begins with the current one to add bundles.
    // Throws std::invalid_argument if tables are on another device.
    void set_bundles(std::vector<std::shared_ptr<const BundleTables>> bundles, cudaStream_t stream);
    // Replaces all instances. The caller must then call set_poses(). Host memory is
    // copied before the function returns. `factors` is empty if all factors are 1.
    void set_instances(Span<const int32_t> bundle, Span<const float> importance,
                       Span<const InstanceFactors> factors, const EnvironmentTable& environments,
                       cudaStream_t stream);
    // Sets the poses of all instances. A component in host memory is copied before the
    // function returns. A component in device memory must not be changed afterwards.
    void set_poses(const PoseSpan& position, const PoseSpan& quaternion, const PoseSpan& scale,
                   cudaStream_t stream);
    // Sets the label of each instance. `label` is empty if no instance has one, and is
    // copied before the function returns.
    void set_labels(Span<const int32_t> label, cudaStream_t stream);

    int device() const { return device_; }
    // Returns the device memory in bytes. It does not include the tables of bundles,
    // which other scenes may share.
    size_t bytes() const;
    size_t num_bundles() const { return bundles_.size(); }
    size_t num_instances() const { return num_instances_; }
    const BundleTables& bundle(size_t b) const { return *bundles_[b]; }

    // Return the bounds for cameras that see all instances, and for cameras that belong
    // to an environment.
    const SeenBounds& seen_by_all() const { return seen_by_all_; }
    const SeenBounds& seen_in_environment() const { return seen_in_environment_; }

    SceneOnDevice on_device() const;
    // Locks the scene while the caller enqueues work on a stream.
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
    DeviceBuffer<int32_t> label_;
    size_t num_labels_ = 0;
    SeenBounds seen_by_all_{}, seen_in_environment_{};
    size_t num_factors_ = 0;
    DeviceBuffer<double> uploaded_[3];
    const double *position_ = nullptr, *quaternion_ = nullptr, *scale_ = nullptr;
};

}  // namespace cuda
}  // namespace v3dg
