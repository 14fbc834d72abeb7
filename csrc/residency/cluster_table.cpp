#include "residency/cluster_table.h"

#include <algorithm>
#include <cmath>

#include "math/gaussian.h"

namespace v3dg {

HostTable::HostTable(const ClusterTable& table, const ClusterAppearance& appearance)
    : table_(table), appearance_(appearance) {
    find_tops();
    table_.bounds = no_box();
    for (const Box& box : table_.box) grow(table_.bounds, box);
    float most_filter_px2 = kFadeFilterPx2;
    for (const float value : appearance.filter_px2)
        most_filter_px2 = std::max(most_filter_px2, value);
    table_.pad_px = static_cast<float>(kReachSigmas) * std::sqrt(most_filter_px2) + 1.0f;
}

void HostTable::find_tops() {
    std::vector<uint8_t> is_top(table_.ball.size, 0);
    for (size_t c = 0; c < table_.num_clusters(); ++c) {
        if (table_.parent_group[c] >= 0) continue;
        top_cluster_.push_back(static_cast<int32_t>(c));
        if (table_.own_group[c] >= 0) is_top[table_.own_group[c]] = 1;
    }
    for (size_t g = 0; g < is_top.size(); ++g)
        if (is_top[g]) top_group_.push_back(static_cast<int32_t>(g));
    table_.top_group = {top_group_.data(), top_group_.size()};
    table_.top_cluster = {top_cluster_.data(), top_cluster_.size()};
}

}  // namespace v3dg
