#pragma once

// Finds the pages that a cut needs, and their urgency, if only some pages of a bundle
// are resident.

#include <cfloat>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "residency/cluster_table.h"
#include "select/fade_math.h"

namespace v3dg {

// Returns the priority of a group's page: above 1 if this cut would refine the group,
// at most 1 if only a cut with a smaller tolerance would. A fade raises the priority.
V3DG_HD inline float priority_of(float metric_px2, const SelectRule& rule) {
    const float ratio = metric_px2 * rule.fade.factor / rule.tolerance_px2;
    if (fits(metric_px2, rule)) return ratio <= 1.0f ? ratio : 0.0f;
    return ratio > 1.0f ? ratio : 1.0f + FLT_EPSILON;
}
// Pages are requested ahead of use from this priority on.
constexpr float kLeastPriority = 0.5f;

// A page that a cut needs, and its priority.
struct PageNeed {
    int32_t page;  // -1: no page
    float priority;
};

// Returns the page that an instance needs because of a cluster that is not culled. The
// pages above that page are needed, too. `priority` maps a group to the priority of its
// page.
//
// Once all pages with a priority above 1 and the pages above those are resident, the
// cut is the same as with every page resident: each cluster of that cut has its page,
// and a cluster that stands in for finer ones requests their page. It requests that
// page even when the page is resident, since all of the finer clusters may be culled: a
// page that was needed only while absent would be loaded and evicted in an endless
// cycle.
template <class Priority>
V3DG_HD inline PageNeed page_need(const ClusterTable& table, size_t c, const Priority& priority) {
    const int32_t own = table.own_group[c], parent = table.parent_group[c];
    const float above = parent < 0 ? INFINITY : priority(parent);
    if (!(above > 1.0f)) return {-1, 0.0f};
    const size_t page = table.page_of(c);
    if (own >= 0 && table.pages.is_resident(page)) {
        const float below = priority(own);
        if (below > kLeastPriority) return {own, below};
    }
    return {static_cast<int32_t>(page), above};
}

}  // namespace v3dg
