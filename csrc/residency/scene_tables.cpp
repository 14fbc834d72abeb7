#include "residency/scene_tables.h"

#include <stdexcept>
#include <utility>

#include "base/device_guard.h"

namespace v3dg {
namespace cuda {

void SceneTables::set_bundles(std::vector<std::shared_ptr<const BundleTables>> bundles,
                              cudaStream_t stream) {
    std::vector<BundleOnDevice> on_device;
    for (const auto& bundle : bundles) {
        if (bundle->device() != device_)
            throw std::invalid_argument(
                "bundles: expected tables on device " + std::to_string(device_) +
                " like the scene, got tables on device " + std::to_string(bundle->device()));
        on_device.push_back(bundle->on_device());
    }
    const DeviceGuard guard(device_);
    const StreamLock lock(busy_, stream);
    bundles_on_device_.copy_from({on_device.data(), on_device.size()}, stream);
    bundles_ = std::move(bundles);
    num_instances_of_.resize(bundles_.size(), 0);
}

void SceneTables::set_instances(Span<const int32_t> bundle, Span<const float> importance,
                                Span<const InstanceFactors> factors, cudaStream_t stream) {
    const DeviceGuard guard(device_);
    const StreamLock lock(busy_, stream);
    num_instances_ = bundle.size;
    num_instances_of_.assign(bundles_.size(), 0);
    for (const int32_t b : bundle) ++num_instances_of_[b];
    bundle_.copy_from(bundle, stream);
    importance_.copy_from(importance, stream);
    factors_.copy_from(factors, stream);
    num_factors_ = factors.size;
}

void SceneTables::set_poses(const PoseSpan& position, const PoseSpan& quaternion,
                            const PoseSpan& scale, cudaStream_t stream) {
    const DeviceGuard guard(device_);
    const StreamLock lock(busy_, stream);
    const auto on_device = [&](const PoseSpan& part, int k) {
        return part.is_on_device ? part.values.data : uploaded_[k].copy_from(part.values, stream);
    };
    position_ = on_device(position, 0);
    quaternion_ = on_device(quaternion, 1);
    scale_ = on_device(scale, 2);
}

size_t SceneTables::bytes() const {
    size_t bytes =
        bundles_on_device_.bytes() + bundle_.bytes() + importance_.bytes() + factors_.bytes();
    for (const DeviceBuffer<double>& poses : uploaded_) bytes += poses.bytes();
    return bytes;
}

SceneOnDevice SceneTables::on_device() const {
    const size_t count = num_instances_;
    return {.bundles = bundles_on_device_.data(),
            .instances = {.bundle = {bundle_.data(), count},
                          .position = {position_, 3 * count},
                          .quaternion = {quaternion_, 4 * count},
                          .scale = {scale_, count},
                          .importance = {importance_.data(), count},
                          .factors = {factors_.data(), num_factors_}}};
}

}  // namespace cuda
}  // namespace v3dg
