#include "fit_group/fit_group_math.h"

namespace v3dg {

FitView fit_view(const FitConfig& config, const FitGroup& group, uint64_t index) {
    return view_of_index(config, group, index);
}

}  // namespace v3dg
