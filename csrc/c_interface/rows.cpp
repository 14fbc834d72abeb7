#include "c_interface/rows.h"

#include <algorithm>

#include "c_interface/fault.h"

namespace v3dg {

void check_room(const v3dg_gaussians& out, uint64_t num_gaussians) {
    check_argument(out.sh_degree >= 0 && out.sh_degree <= kMaxShDegree, "gaussians.sh_degree",
                   "0 to 3, got " + std::to_string(out.sh_degree));
    check_argument(out.capacity >= num_gaussians, "gaussians.capacity",
                   "room for " + std::to_string(num_gaussians) + " gaussians, got " +
                       std::to_string(out.capacity));
}

void copy_rows(const GaussianRows<const float>& rows, const v3dg_gaussians& out, size_t first) {
    const auto copy = [&](const float* from, float* to, size_t width) {
        if (to != nullptr) std::copy_n(from, rows.size * width, to + first * width);
    };
    copy(rows.means, out.means, 3);
    copy(rows.quats, out.quaternions, 4);
    copy(rows.scales, out.scales, 3);
    copy(rows.opacities, out.opacities, 1);
    if (out.sh == nullptr) return;
    const auto width = static_cast<size_t>(3 * num_sh_bases(out.sh_degree));
    const auto source_width = static_cast<size_t>(rows.num_sh());
    const size_t common = std::min(width, source_width);
    for (size_t i = 0; i < rows.size; ++i) {
        float* to = out.sh + (first + i) * width;
        std::copy_n(rows.sh + i * source_width, common, to);
        std::fill(to + common, to + width, 0.0f);
    }
}

}  // namespace v3dg
