#pragma once

// The instances of a scene, or a part of them, in memory of their own.

#include <vector>

#include "residency/instance_table.h"

namespace v3dg {

// The columns that an InstanceTable refers to.
struct InstanceColumns {
    std::vector<int32_t> bundle;
    std::vector<double> position, quaternion, scale;
    std::vector<float> importance;
    std::vector<InstanceFactors> factors;  // empty if all are 1

    InstanceTable table() const {
        return {.bundle = {bundle.data(), bundle.size()},
                .position = {position.data(), position.size()},
                .quaternion = {quaternion.data(), quaternion.size()},
                .scale = {scale.data(), scale.size()},
                .importance = {importance.data(), importance.size()},
                .factors = {factors.data(), factors.size()}};
    }
};

}  // namespace v3dg
