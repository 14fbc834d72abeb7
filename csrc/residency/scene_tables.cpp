// Implements scene_tables.h. It uploads instances and poses, and computes bounds on
// what one camera sees.

#include "residency/scene_tables.h"

#include <algorithm>
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
}

void SceneTables::set_instances(Span<const int32_t> bundle, Span<const float> importance,
                                Span<const InstanceFactors> factors,
                                const EnvironmentTable& environments, cudaStream_t stream) {
    const DeviceGuard guard(device_);
    const StreamLock lock(busy_, stream);
    num_instances_ = bundle.size;
    bundle_.copy_from(bundle, stream);
    importance_.copy_from(importance, stream);
    factors_.copy_from(factors, stream);
    num_factors_ = factors.size;
    environment_order_.copy_from(environments.order, stream);
    environment_begin_.copy_from(environments.begin, stream);
    num_environment_begins_ = environments.begin.size;
    find_bounds(bundle, environments);
}

void SceneTables::find_bounds(Span<const int32_t> bundle, const EnvironmentTable& environments) {
    const auto bounds_of = [&](int32_t first, int32_t end) {
        SeenBounds seen{.instances = static_cast<size_t>(end - first), .parts = 0};
        for (int32_t k = first; k < end; ++k) {
            const size_t num_clusters = bundles_[bundle[environments.order[k]]]->num_clusters();
            seen.parts += num_clusters / kClustersOfPart + 1;
        }
        return seen;
    };
    seen_by_all_ = bounds_of(0, static_cast<int32_t>(bundle.size));
    const SeenBounds shared = bounds_of(0, environments.begin[0]);
    SeenBounds own{};
    for (int32_t e = 0; e < environments.num_environments(); ++e) {
        const SeenBounds seen = bounds_of(environments.begin[e], environments.begin[e + 1]);
        own = {.instances = std::max(own.instances, seen.instances),
               .parts = std::max(own.parts, seen.parts)};
    }
    seen_in_environment_ = {.instances = shared.instances + own.instances,
                            .parts = shared.parts + own.parts};
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

void SceneTables::set_labels(Span<const int32_t> label, cudaStream_t stream) {
    const DeviceGuard guard(device_);
    const StreamLock lock(busy_, stream);
    label_.copy_from(label, stream);
    num_labels_ = label.size;
}

size_t SceneTables::bytes() const {
    size_t bytes =
        bundles_on_device_.bytes() + bundle_.bytes() + importance_.bytes() + factors_.bytes();
    bytes += environment_order_.bytes() + environment_begin_.bytes() + label_.bytes();
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
                          .factors = {factors_.data(), num_factors_}},
            .environments = {.order = {environment_order_.data(), count},
                             .begin = {environment_begin_.data(), num_environment_begins_}},
            .label = {label_.data(), num_labels_}};
}

}  // namespace cuda
}  // namespace v3dg
