#include "c_interface/scene.h"

#include <algorithm>

namespace v3dg {

InstanceColumns::InstanceColumns(const std::vector<v3dg_instance>& instances) {
    bool are_all_one = true;
    for (const v3dg_instance& instance : instances) {
        bundle_.push_back(static_cast<int32_t>(instance.bundle));
        position_.insert(position_.end(), instance.position, instance.position + 3);
        quaternion_.insert(quaternion_.end(), instance.quaternion, instance.quaternion + 4);
        scale_.push_back(instance.scale);
        importance_.push_back(instance.importance);
        InstanceFactors factors{};
        std::copy_n(instance.tint, 3, factors.color);
        factors.opacity = instance.opacity;
        factors_.push_back(factors);
        for (const float factor : {factors.color[0], factors.color[1], factors.color[2]})
            are_all_one = are_all_one && factor == 1;
        are_all_one = are_all_one && factors.opacity == 1;
    }
    if (are_all_one) factors_.clear();
}

InstanceTable InstanceColumns::table() const {
    return {.bundle = {bundle_.data(), bundle_.size()},
            .position = {position_.data(), position_.size()},
            .quaternion = {quaternion_.data(), quaternion_.size()},
            .scale = {scale_.data(), scale_.size()},
            .importance = {importance_.data(), importance_.size()},
            .factors = {factors_.data(), factors_.size()}};
}

}  // namespace v3dg
