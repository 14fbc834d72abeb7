#pragma once

// Decides whether a cluster is drawn, and with which weight. select_math.h proves that
// the cut is exact.

#include <cstddef>
#include <cstdint>

#include "residency/cluster_table.h"
#include "select/budget_math.h"
#include "select/fade_math.h"
#include "select/footprint.h"
#include "select/frustum.h"

namespace v3dg {

// Returns whether the cut of an instance consists of the top clusters, each with weight
// 1. Such a cut depends on no page. All top groups are tested. The paper's footprint is
// excluded: it may decrease towards the root, so a group below a fitting top group
// could be refined.
V3DG_HD inline bool tops_fit(const ClusterTable& table, const InstanceView& view,
                             const SelectRule& rule) {
    if (rule.footprint == Footprint::paper) return false;
    for (size_t i = 0; i < table.top_group.size; ++i)
        if (!fits(wanted_metric_px2(table, table.top_group[i], view, rule), rule)) return false;
    return true;
}

// Which clusters the cut of an instance can contain.
enum class CutSource {
    nowhere,  // none, because the instance is hidden
    tops,     // the top clusters, which no group replaces
    table,    // all clusters of the table
};

// Returns whether the whole instance is outside the frustum.
V3DG_HD inline bool is_hidden(const ClusterTable& table, const InstanceView& view,
                              const SelectRule& rule) {
    return rule.culls && is_outside(table.bounds, view);
}

// Returns the source of an instance's cut. The result is CutSource::tops only if the
// bundle has at most `most_tops` top clusters.
V3DG_HD inline CutSource source_of_cut(const ClusterTable& table, const InstanceView& view,
                                       const SelectRule& rule, size_t most_tops) {
    if (is_hidden(table, view, rule)) return CutSource::nowhere;
    const bool has_few_tops = table.top_cluster.size <= most_tops;
    return has_few_tops && tops_fit(table, view, rule) ? CutSource::tops : CutSource::table;
}

// A range of bins whose cuts contain a certain cluster.
struct BinRange {
    uint32_t first, end;

    V3DG_HD bool is_empty() const { return first >= end; }
};

// Computes the state of a group anew at each call. The bins of a budget assume that all
// pages are resident, so that the tolerance does not depend on residency.
struct AskedGroups {
    const ClusterTable& table;
    const InstanceView& view;
    const SelectRule& rule;

    V3DG_HD int32_t refinement(int32_t g) const {
        return min_of(v3dg::refinement(metric_px2(table, g, view, rule), rule),
                      arrival(table.pages, g, rule));
    }
    // Return the first bin in which the group fits, and the first in which it is not
    // refined.
    V3DG_HD uint32_t first_fitting(int32_t g) const {
        return bin_of_metric(wanted_metric_px2(table, g, view, rule) * rule.fade.factor,
                             rule.tolerance_px2);
    }
    V3DG_HD uint32_t first_unrefined(int32_t g) const {
        return bin_of_metric(wanted_metric_px2(table, g, view, rule) * rule.fade.inverse,
                             rule.tolerance_px2);
    }
};

// Decides about each cluster of one instance. `Groups` is AskedGroups, or a type with
// the same members that looks up stored results.
template <class Groups>
struct InstanceCut {
    const ClusterTable& table;
    const InstanceView& view;
    const SelectRule& rule;
    Groups groups;
    bool culls;  // false if all boxes are inside the frustum

    V3DG_HD bool is_culled(size_t c) const { return culls && is_outside(table.box[c], view); }

    // Returns the weight of a cluster before culling, in units of 1 / kWhole. The
    // weight is the refinement of its parent group minus the refinement of its own
    // group (select_math.h).
    V3DG_HD int32_t weight(size_t c) const {
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        const int32_t below = own < 0 ? 0 : groups.refinement(own);
        const int32_t above = parent < 0 ? kWhole : groups.refinement(parent);
        return above - below;
    }

    // Like weight(), but 0 for clusters that are culled or not in the cut.
    V3DG_HD int32_t drawn_weight(size_t c) const {
        const int32_t drawn = weight(c);
        return drawn > 0 && !is_culled(c) ? drawn : 0;
    }

    // Returns the bins whose cuts contain the cluster. With a fade, the range may be
    // too large.
    V3DG_HD BinRange bins(size_t c) const {
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        const BinRange range{own < 0 ? 0 : groups.first_unrefined(own),
                             parent < 0 ? kNumBudgetBins : groups.first_fitting(parent)};
        return range.is_empty() || is_culled(c) ? BinRange{0, 0} : range;
    }
};

// Returns the decisions of an instance. The states of groups are computed anew at each
// call.
V3DG_HD inline InstanceCut<AskedGroups> cut_by_asking(const ClusterTable& table,
                                                      const InstanceView& view,
                                                      const SelectRule& rule) {
    return {.table = table,
            .view = view,
            .rule = rule,
            .groups = {.table = table, .view = view, .rule = rule},
            .culls = rule.culls};
}

}  // namespace v3dg
