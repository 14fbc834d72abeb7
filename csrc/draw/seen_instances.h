#pragma once

// The instances of one environment on the host, and the shared ones.

#include <vector>

#include "draw/scene_frame.h"
#include "residency/environments.h"
#include "residency/instance_columns.h"

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
            columns_.bundle.push_back(all.bundle[i]);
            append(columns_.position, &all.position[3 * i], 3);
            append(columns_.quaternion, &all.quaternion[4 * i], 4);
            columns_.scale.push_back(all.scale[i]);
            columns_.importance.push_back(all.importance[i]);
            if (!all.factors.empty()) columns_.factors.push_back(all.factors[i]);
        }
    }
    InstanceTable table() const { return columns_.table(); }
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
    static void append(std::vector<double>& column, const double* values, size_t count) {
        column.insert(column.end(), values, values + count);
    }

    std::vector<int32_t> ids_;
    InstanceColumns columns_;
};

}  // namespace v3dg
