#pragma once

// Finds the pages that a cut needs, and their priorities. Used if only some pages of a
// bundle are resident.

#include <cfloat>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "residency/cluster_table.h"
#include "select/fade_math.h"

namespace v3dg {

// Returns the priority of a group's page. It is above 1 if the cut would refine the
// group. It is at most 1 if only a cut with a smaller tolerance would refine it. A fade
// raises the priority.
V3DG_HD inline float priority_of(float metric_px2, const SelectRule& rule) {
    const float ratio = metric_px2 * rule.fade.factor / rule.tolerance_px2;
    if (fits(metric_px2, rule)) return ratio <= 1.0f ? ratio : 0.0f;
    return ratio > 1.0f ? ratio : 1.0f + FLT_EPSILON;
}
// Pages with at least this priority are requested. Pages that the cut needs now have a
// priority above 1, so other pages are requested before a cut needs them.
constexpr float kLeastPriority = 0.5f;

// A page that a cut needs.
struct PageNeed {
    int32_t page;  // -1 if no page is needed
    float priority;
};

// Returns the page that an instance needs because of cluster c, which must not be
// culled. The pages above that page are needed, too. priority(g) returns the priority
// of group g's page.
//
// If all pages with a priority above 1 are resident, and all pages above them, the cut
// is the same as if every page were resident. A cluster that is drawn in place of finer
// clusters requests their page, even if that page is already resident. Without this
// rule, a page whose clusters are all culled would count as needed only while it is
// absent; it would be loaded and evicted again and again.
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
