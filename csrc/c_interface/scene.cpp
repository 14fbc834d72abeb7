#include "c_interface/scene.h"

#include <algorithm>

namespace v3dg {

InstanceColumns columns_of(const std::vector<v3dg_instance>& instances) {
    InstanceColumns columns;
    bool are_all_one = true;
    for (const v3dg_instance& instance : instances) {
        columns.bundle.push_back(static_cast<int32_t>(instance.bundle));
        columns.position.insert(columns.position.end(), instance.position, instance.position + 3);
        columns.quaternion.insert(columns.quaternion.end(), instance.quaternion,
                                  instance.quaternion + 4);
        columns.scale.push_back(instance.scale);
        columns.importance.push_back(instance.importance);
        InstanceFactors factors{};
        std::copy_n(instance.tint, 3, factors.color);
        factors.opacity = instance.opacity;
        columns.factors.push_back(factors);
        for (const float factor : {factors.color[0], factors.color[1], factors.color[2]})
            are_all_one = are_all_one && factor == 1;
        are_all_one = are_all_one && factors.opacity == 1;
    }
    if (are_all_one) columns.factors.clear();
    return columns;
}

}  // namespace v3dg
