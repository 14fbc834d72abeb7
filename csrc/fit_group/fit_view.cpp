// Functions of fit_group.h about views, in a file of their own, so that callers do not
// include the formulas.

#include <stdexcept>
#include <string>

#include "fit_group/fit_group_math.h"

namespace v3dg {

void check_size(const FitConfig& config, const FitGroup& group) {
    if (config.image_size > 0) return;
    const double side = config.supersample * size_of_group(config, group).side;
    if (!(side <= UINT16_MAX))
        throw std::invalid_argument(
            "px2_per_gaussian, distance, supersample: expected pictures of at most " +
            std::to_string(UINT16_MAX) + " px, got larger ones for a group of " +
            std::to_string(group.count) + " gaussians");
}

FitView fit_view(const FitConfig& config, const FitGroup& group, uint64_t index) {
    return view_of_index(config, group, index);
}

}  // namespace v3dg
