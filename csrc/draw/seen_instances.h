#pragma once

// The instances of one environment on the host, and the shared ones.

#include <vector>

#include "draw/scene_frame.h"
#include "residency/environments.h"

namespace v3dg {

// The instances of a scene that one camera or sensor sees, in the order of their slots.
class SeenInstances {
  public:
    SeenInstances(const InstanceTable& all, const EnvironmentTable& environments,
                  int32_t environment) {
        const int32_t count = environments.num_slots(environment);
        for (int32_t slot = 0; slot < count; ++slot) {
            const auto i = static_cast<size_t>(environments.instance_of(environment, slot));
            ids_.push_back(static_cast<int32_t>(i));
            bundle_.push_back(all.bundle[i]);
            position_.insert(position_.end(), &all.position[3 * i], &all.position[3 * i] + 3);
            quaternion_.insert(quaternion_.end(), &all.quaternion[4 * i],
                               &all.quaternion[4 * i] + 4);
            scale_.push_back(all.scale[i]);
            importance_.push_back(all.importance[i]);
            if (!all.factors.empty()) factors_.push_back(all.factors[i]);
        }
    }
    InstanceTable table() const {
        return {.bundle = {bundle_.data(), bundle_.size()},
                .position = {position_.data(), position_.size()},
                .quaternion = {quaternion_.data(), quaternion_.size()},
                .scale = {scale_.data(), scale_.size()},
                .importance = {importance_.data(), importance_.size()},
                .factors = {factors_.data(), factors_.size()}};
    }
    // Returns the ids of the instances in the whole scene.
    Span<const int32_t> ids() const { return {ids_.data(), ids_.size()}; }
    // Returns the scene with only these instances. It refers to this object.
    HostScene part_of(const HostScene& scene) const {
        HostScene part = scene;
        part.instances = table();
        part.instance_ids = ids();
        return part;
    }

  private:
    std::vector<int32_t> ids_, bundle_;
    std::vector<double> position_, quaternion_, scale_;
    std::vector<float> importance_;
    std::vector<InstanceFactors> factors_;
};

}  // namespace v3dg
