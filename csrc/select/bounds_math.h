#pragma once

// Bounds on runs of adjacent clusters. If a bound shows that no cluster of a run is
// drawn, its clusters are not tested one by one. A bound never changes a decision,
// because its margin exceeds the rounding errors of the bound and of the metric.

#include <cmath>
#include <cstdint>

#include "residency/cluster_bounds.h"
#include "residency/cluster_table.h"
#include "select/fade_math.h"
#include "select/footprint.h"
#include "select/frustum.h"

namespace v3dg {

// The relative margin between a metric and its bound.
constexpr float kBoundMargin = 1e-3f;

// Returns true only if the parent group of each cluster fits the tolerance, so that
// none of the clusters is drawn.
V3DG_HD inline bool parents_fit(const ClusterBounds& bounds, const InstanceView& view,
                                const SelectRule& rule) {
    if (bounds.has_root || rule.footprint == Footprint::paper) return false;
    const float distance = sqrtf(distance2_to(bounds.parents, view)) - bounds.parents.radius;
    return distance > 0.0f && footprint_at(bounds.most_parent_radius, distance * distance, view) *
                                      bounds.most_parent_weight * rule.fade.factor <=
                                  (1.0f - kBoundMargin) * rule.tolerance_px2;
}

// Returns true only if the own group of each cluster is refined, so that none of the
// clusters is drawn.
V3DG_HD inline bool owns_are_refined(const ClusterBounds& bounds, const InstanceView& view,
                                     const SelectRule& rule) {
    if (bounds.has_leaf || bounds.least_own_level <= rule.min_level ||
        rule.footprint == Footprint::paper)
        return false;
    const float distance = sqrtf(distance2_to(bounds.owns, view)) + bounds.owns.radius;
    return footprint_at(bounds.least_own_radius, distance * distance, view) *
               bounds.least_own_weight * rule.fade.inverse >
           (1.0f + kBoundMargin) * rule.tolerance_px2;
}

// The tolerances for which a bound must hold: only the tolerance of the rule, or also
// all larger ones.
enum class Tolerances { this_one, from_this_on };

// Returns false only if none of the clusters is drawn at these tolerances. The bounds
// ignore which pages are resident. A group whose page is absent counts as fitting, so
// owns_are_refined() may only be used if all pages are resident.
V3DG_HD inline bool may_draw(const ClusterTable& table, const ClusterBounds& bounds,
                             const InstanceView& view, const SelectRule& rule,
                             Tolerances tolerances) {
    return !(rule.culls && is_outside(bounds.box, view)) && !parents_fit(bounds, view, rule) &&
           (tolerances == Tolerances::from_this_on || !table.pages.is_whole() ||
            !owns_are_refined(bounds, view, rule));
}

// Clusters [first, end) of a table.
struct ClusterRange {
    uint32_t first, end;
};

// Upper bound on the solid angle of a ball whose radius is at most half its distance.
// If x2 is the square of radius / distance, the solid angle is between pi x2 and
// kMostOfPi x2 steradians.
constexpr float kMostOfPi = 1.08f;
// Limits for testing whole runs. Outside these limits, float32 may lose digits, or
// squares may overflow.
constexpr float kLeastRunTolerance = 1e-20f, kLeastRunX2 = 1e-30f, kMostRunDistance = 1e18f;

// Returns the clusters that must be tested one by one, a contiguous range of whole
// runs. No cluster outside the range is drawn at these tolerances.
V3DG_HD inline ClusterRange clusters_to_ask(const ClusterTable& table, const ClusterRuns& runs,
                                            const InstanceView& view, const SelectRule& rule,
                                            Tolerances tolerances) {
    const float distance = sqrtf(distance2_to(runs.groups, view));
    const float nearest = distance - runs.groups.radius, farthest = distance + runs.groups.radius;
    const float x2 =
        // (radius / distance)² of a ball whose footprint equals the tolerance
        rule.tolerance_px2 / (float(kPi) * view.px2_per_steradian);
    uint32_t first = 0, last = runs.count;
    if (rule.footprint == Footprint::solid_angle && nearest >= runs.least_distance &&
        farthest <= kMostRunDistance && rule.tolerance_px2 >= kLeastRunTolerance &&
        x2 >= kLeastRunX2) {
        const float low = (1.0f - kBoundMargin) * x2 / rule.fade.factor;
        const float most = nearest * sqrtf(low / kMostOfPi);
        while (first < last && runs.most_parent[first] <= most) ++first;
        const float high = (1.0f + kBoundMargin) * x2 / rule.fade.inverse;
        const float least = farthest * sqrtf(high);
        if (tolerances == Tolerances::this_one && table.pages.is_whole() &&
            runs.least_level > rule.min_level)
            while (first < last && runs.least_own[last - 1] > least) --last;
    }
    const uint32_t end = min_of(runs.begin[last], static_cast<uint32_t>(table.num_clusters()));
    return {min_of(runs.begin[first], end), end};
}

}  // namespace v3dg
