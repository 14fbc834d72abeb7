#pragma once

// The decisions of selection, compiled without contraction on both halves so that they give the
// same bits.
//
// InstanceCut::drawn_weight() decides: a cluster is drawn when the group above is refined further
// than its own, and it is not culled. Without a fade a group is refined when it does not fit, so
// the one fits and the other does not. Every comparison of a metric with the tolerance goes through
// fits() and is_refined(), which without a fade are each other's opposite: what one test accepts,
// the other refuses.

#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "math/solid_angle.h"
#include "residency/cluster_bounds.h"
#include "residency/cluster_table.h"

namespace v3dg {

enum class Footprint {
    solid_angle,  // what the ball covers of the sphere around the eye; turning the camera changes
                  // nothing
    paper,        // pi r^2 fx fy / depth^2; Yang et al., SIGGRAPH 2025
};

constexpr int kNumPlanes = 5;

// A frustum plane pushed outwards. A point is outside by normal . p + offset, if that is positive.
struct Plane {
    float normal[3], offset;
    // A gaussian's image reaches this much farther, per unit of its box's half depth, than the box
    // itself, because its projection is linearised at its mean.
    float guard;
};

// A camera, or two eyes, as one instance sees them: in the instance's own frame and units. Of two
// eyes the nearer one counts, and planes have both frusta inside. Aligned, so that a thread reads
// and writes it in few instructions.
struct alignas(16) InstanceView {
    float eye[3], other_eye[3];
    bool has_other_eye;
    float forward[3];         // unit length
    float px2_per_steradian;  // times the instance's importance
    Plane plane[kNumPlanes];
};

constexpr uint64_t kNoBudget = ~uint64_t(0);

// Metrics within this factor of the tolerance are between two levels, which are then both drawn.
struct Fade {
    float factor = 1.0f, inverse = 1.0f;

    V3DG_HD bool is_on() const { return factor > 1.0f; }
    bool operator==(const Fade& other) const {
        return factor == other.factor && inverse == other.inverse;
    }
};

// How the tolerance of a budget comes about.
enum class BudgetPace {
    at_once,   // from one view alone
    in_steps,  // from that of the frame before, too, so that slow motion sees no leap of it
               // (budget_steps.h)
    again,     // of a frame that is drawn once more: no step, unless the budget wants it
};

struct SelectRule {
    float tolerance_px2;
    Footprint footprint = Footprint::solid_angle;
    bool culls = true;            // drop what lies outside the frustum
    int32_t min_level = 0;        // nothing finer is drawn
    uint64_t budget = kNoBudget;  // most gaussians; the tolerance is raised until they fit
    BudgetPace pace = BudgetPace::at_once;
    int32_t frames_at_rest = 0;  // in steps: in so many frames up to this one nothing has moved
    Fade fade = {};     // not with the paper's footprint, which may decrease towards the root
    int32_t frame = 0;  // with a fade: up to which pages of a pool have faded in

    bool operator==(const SelectRule& o) const {
        return tolerance_px2 == o.tolerance_px2 && footprint == o.footprint && culls == o.culls &&
               min_level == o.min_level && budget == o.budget && pace == o.pace &&
               frames_at_rest == o.frames_at_rest && fade == o.fade && frame == o.frame;
    }
};

V3DG_HD inline float distance2_from(const float eye[3], const Ball& ball) {
    const float dx = ball.x - eye[0], dy = ball.y - eye[1], dz = ball.z - eye[2];
    return dx * dx + dy * dy + dz * dz;
}
V3DG_HD inline float distance2_to(const Ball& ball, const InstanceView& view) {
    const float distance2 = distance2_from(view.eye, ball);
    return view.has_other_eye ? min_of(distance2, distance2_from(view.other_eye, ball)) : distance2;
}

// Screen area, px2, of a ball whose centre is this far from the eye, squared.
V3DG_HD inline float footprint_at(float radius, float distance2, const InstanceView& view) {
    const float x2 = radius * radius / distance2;
    const float area = solid_angle_of_ball(x2) * view.px2_per_steradian;
    return x2 < 1.0f ? area : INFINITY;
}

// Screen area that the ball covers, px2. +inf when the eye is inside, or where there is no number.
V3DG_HD inline float footprint_px2(const Ball& ball, const InstanceView& view,
                                   Footprint footprint) {
    if (footprint == Footprint::solid_angle)
        return footprint_at(ball.radius, distance2_to(ball, view), view);
    const float depth = (ball.x - view.eye[0]) * view.forward[0] +
                        (ball.y - view.eye[1]) * view.forward[1] +
                        (ball.z - view.eye[2]) * view.forward[2];
    const float area =
        float(kPi) * (ball.radius * ball.radius / (depth * depth)) * view.px2_per_steradian;
    return area >= 0.0f ? area : INFINITY;
}

// Screen area, px2, that one gaussian of the clusters made by group g stands for, whichever pages
// are resident. 0 where nothing finer may be drawn, so that the group always fits.
V3DG_HD inline float wanted_metric_px2(const ClusterTable& table, int32_t g,
                                       const InstanceView& view, const SelectRule& rule) {
    const float metric = footprint_px2(table.ball[g], view, rule.footprint) * table.weight[g];
    return table.level[g] <= rule.min_level ? 0.0f : metric;
}

// The same as the cut takes it: 0, too, where what is finer is not resident. Both are closed
// towards the root, and so is what is wanted and resident: the cut stays exact.
V3DG_HD inline float metric_px2(const ClusterTable& table, int32_t g, const InstanceView& view,
                                const SelectRule& rule) {
    return table.pages.is_resident(g) ? wanted_metric_px2(table, g, view, rule) : 0.0f;
}

V3DG_HD inline bool fits(float metric_px2, const SelectRule& rule) {
    return metric_px2 * rule.fade.factor <= rule.tolerance_px2;
}
V3DG_HD inline bool is_refined(float metric_px2, const SelectRule& rule) {
    return !(metric_px2 * rule.fade.inverse <= rule.tolerance_px2);
}

// Weights are whole numbers of so many parts, so that they add up without rounding.
constexpr int32_t kWhole = 1 << 15;

V3DG_HD inline float share_of(int32_t weight) {
    return static_cast<float>(weight) * (1.0f / kWhole);
}

// How far a group is refined: 0 where it fits, kWhole where it is refined, in between a ramp. Never
// decreases with the metric, because no step of it does.
V3DG_HD inline int32_t refinement(float metric_px2, const SelectRule& rule) {
    const float low = rule.tolerance_px2 * rule.fade.inverse,
                high = rule.tolerance_px2 * rule.fade.factor;
    const float ramp = (metric_px2 - low) / (high - low);
    const float between =
        ramp > 0.0f ? (ramp < 1.0f ? ramp : 1.0f) : 0.0f;  // 0 where there is no number
    const int32_t rounded = static_cast<int32_t>(between * kWhole + 0.5f);
    return fits(metric_px2, rule) ? 0 : is_refined(metric_px2, rule) ? kWhole : rounded;
}

// How far a page has faded in, of kWhole. Groups are refined as far as their pages have, at most:
// as both never decrease towards the root, the lesser of the two does not, and the cut stays exact.
V3DG_HD inline int32_t arrival(const PageTable& pages, int32_t g, const SelectRule& rule) {
    static_assert(kWhole % kArrivalFrames == 0, "frames are whole parts");
    return rule.fade.is_on() ? pages.arrived(g, rule.frame) * (kWhole / kArrivalFrames) : kWhole;
}

// Where a box lies as seen from one plane, in units of the plane's normal.
struct PlaneSide {
    float nearest, farthest;  // signed distance of the box's innermost and outermost corner
    float reach;  // how far gaussians may reach inwards of the box, and bound on rounding
};

V3DG_HD inline PlaneSide side_of(const Box& box, const InstanceView& view, int p) {
    const Plane& plane = view.plane[p];
    float middle = plane.offset, spread = 0.0f, terms = fabsf(plane.offset), half_depth = 0.0f;
    for (int a = 0; a < 3; ++a) {
        const float center = 0.5f * box.lo[a] + 0.5f * box.hi[a];
        const float half = 0.5f * box.hi[a] - 0.5f * box.lo[a];
        middle += plane.normal[a] * center;
        spread += fabsf(plane.normal[a]) * half;
        terms += fabsf(plane.normal[a]) * (fabsf(center) + half);
        half_depth += fabsf(view.forward[a]) * half;
    }
    return {middle - spread, middle + spread,
            plane.guard * half_depth + 16.0f * FLT_EPSILON * terms};
}

// Whether nothing of the gaussians in the box can touch a pixel. False where there is no number.
V3DG_HD inline bool is_outside(const Box& box, const InstanceView& view) {
    for (int p = 0; p < kNumPlanes; ++p) {
        const PlaneSide side = side_of(box, view, p);
        if (side.nearest > side.reach) return true;
    }
    return false;
}

// Whether no box within this one is outside. False where there is no number.
V3DG_HD inline bool is_inside(const Box& box, const InstanceView& view) {
    for (int p = 0; p < kNumPlanes; ++p) {
        const PlaneSide side = side_of(box, view, p);
        if (!(side.farthest + side.reach < 0.0f)) return false;
    }
    return true;
}

// The tolerances that a budget chooses from: the rule's own, then 2048 to an octave, and infinity.
// A metric belongs to the first of them that it fits; what is no number, to the bin after the last.
constexpr int kLog2StepsPerOctave = 11, kOctaves = 32;
constexpr uint32_t kNumBudgetBins = 2 + (kOctaves << kLog2StepsPerOctave);
constexpr uint32_t kFirstStepBits = 0x3a800000u;  // of the float 2^-10
constexpr int kStepShift = 23 - kLog2StepsPerOctave;

V3DG_HD inline uint32_t bin_of_metric(float metric, float tolerance) {
    if (metric <= tolerance) return 0;
    uint32_t bits;  // of a positive float, so they order as it does
    std::memcpy(&bits, &metric, sizeof bits);
    if (bits <= kFirstStepBits) return 1;
    if (!(metric <= INFINITY)) return kNumBudgetBins;
    const uint32_t step = (bits - kFirstStepBits + (1u << kStepShift) - 1) >> kStepShift;
    return step + 1 < kNumBudgetBins ? step + 1 : kNumBudgetBins - 1;
}
V3DG_HD inline float tolerance_of_bin(uint32_t bin, float tolerance) {
    if (bin == 0) return tolerance;
    if (bin == kNumBudgetBins - 1) return INFINITY;
    const uint32_t bits = kFirstStepBits + ((bin - 1) << kStepShift);
    float value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

// In steps, a budget's tolerance goes towards the one at which this part of the budget stays free,
// so that what comes into view seldom makes it leap: a share of the way, and a least number of
// bins. A band of the usual fade is 117 bins wide. From some distance on the motion is not slow,
// and it goes all the way. At rest it arrives in so many frames, in steps of about the same size.
constexpr uint64_t kHeadroomParts = 32;
constexpr uint32_t kStepParts = 32, kLeastStepBins = 6, kLeapBins = 512;
constexpr int32_t kRestFrames = 8;
constexpr uint32_t kNoBin = ~uint32_t(0);  // of the frame before, where there was none

V3DG_HD inline uint64_t goal_of_budget(uint64_t budget) { return budget - budget / kHeadroomParts; }

// The tolerance that is drawn with. `least` and `goal` are the first bins from which on no cut
// exceeds the budget and its goal, kNumBudgetBins where there is none; `least` is one. Never below
// the least bin, which would exceed the budget. `last` becomes the bin of this frame.
V3DG_HD inline float tolerance_of_budget(const SelectRule& rule, uint32_t least, uint32_t goal,
                                         uint32_t& last) {
    if (rule.pace == BudgetPace::at_once) return tolerance_of_bin(least, rule.tolerance_px2);
    const uint32_t floor = bin_of_metric(rule.tolerance_px2, 0.0f);  // no bin below is drawn with
    goal = max_of(floor, min_of(goal, kNumBudgetBins - 1));
    const uint32_t from = last == kNoBin ? goal : last,
                   way = goal > from ? goal - from : from - goal;
    const auto frames_left = static_cast<uint32_t>(kRestFrames + 1 - rule.frames_at_rest);
    const uint32_t in_motion = min_of(way, max_of(way / kStepParts, kLeastStepBins));
    uint32_t step = rule.frames_at_rest > 0 ? (way + frames_left - 1) / frames_left : in_motion;
    if (way > kLeapBins) step = way;
    if (rule.pace == BudgetPace::again) step = 0;
    last = max_of(max_of(least, floor), goal > from ? from + step : from - step);
    // The floor is rounded up, so that its own cut may fit where that of the rule's tolerance does
    // not.
    return last == floor && least == 0 ? rule.tolerance_px2
                                       : tolerance_of_bin(last, rule.tolerance_px2);
}

// Whether the clusters that nothing replaces are the cut, at full weight, and no page is wanted.
// The paper's footprint does not grow towards the root, so that a group may fail to fit below one
// that does.
V3DG_HD inline bool tops_fit(const ClusterTable& table, const InstanceView& view,
                             const SelectRule& rule) {
    if (rule.footprint == Footprint::paper) return false;
    for (size_t i = 0; i < table.top_group.size; ++i)
        if (!fits(wanted_metric_px2(table, table.top_group[i], view, rule), rule)) return false;
    return true;
}

// Where the cut of an instance is found.
enum class CutSource {
    nowhere,  // the instance is hidden
    tops,     // among the clusters that nothing replaces
    table,    // by asking every cluster
};

V3DG_HD inline bool is_hidden(const ClusterTable& table, const InstanceView& view,
                              const SelectRule& rule) {
    return rule.culls && is_outside(table.bounds, view);
}

// The tops are asked only where there are at most `most_tops` of them.
V3DG_HD inline CutSource source_of_cut(const ClusterTable& table, const InstanceView& view,
                                       const SelectRule& rule, size_t most_tops) {
    if (is_hidden(table, view, rule)) return CutSource::nowhere;
    const bool has_few_tops = table.top_cluster.size <= most_tops;
    return has_few_tops && tops_fit(table, view, rule) ? CutSource::tops : CutSource::table;
}

// The tolerances, among those that a budget chooses from, whose cuts have a cluster.
struct BinRange {
    uint32_t first, end;

    V3DG_HD bool is_empty() const { return first >= end; }
};

// What the decision asks of a group, answered when it is asked. A budget counts as if all pages
// were resident, so that its tolerance does not depend on which of them are.
struct AskedGroups {
    const ClusterTable& table;
    const InstanceView& view;
    const SelectRule& rule;

    V3DG_HD int32_t refinement(int32_t g) const {
        return min_of(v3dg::refinement(metric_px2(table, g, view, rule), rule),
                      arrival(table.pages, g, rule));
    }
    // The first of the tolerances that a budget chooses from at which it fits, and is not refined
    // any more.
    V3DG_HD uint32_t first_fitting(int32_t g) const {
        return bin_of_metric(wanted_metric_px2(table, g, view, rule) * rule.fade.factor,
                             rule.tolerance_px2);
    }
    V3DG_HD uint32_t first_unrefined(int32_t g) const {
        return bin_of_metric(wanted_metric_px2(table, g, view, rule) * rule.fade.inverse,
                             rule.tolerance_px2);
    }
};

// The decision, cluster by cluster of an instance's table. `Groups` is AskedGroups, or has its
// answers.
template <class Groups>
struct InstanceCut {
    const ClusterTable& table;
    const InstanceView& view;
    const SelectRule& rule;
    Groups groups;
    bool culls;  // whether some of the clusters may lie outside

    V3DG_HD bool is_culled(size_t c) const { return culls && is_outside(table.box[c], view); }

    // How much of the cluster is drawn, of kWhole, if it is not culled. Below the leaves everything
    // fits, above the roots nothing does; so the weights on a path from a leaf to its root add up
    // to kWhole, and none is negative where metrics never decrease towards the root.
    V3DG_HD int32_t weight(size_t c) const {
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        const int32_t below = own < 0 ? 0 : groups.refinement(own);
        const int32_t above = parent < 0 ? kWhole : groups.refinement(parent);
        return above - below;
    }

    // The same of what is drawn, else 0.
    V3DG_HD int32_t drawn_weight(size_t c) const {
        const int32_t drawn = weight(c);
        return drawn > 0 && !is_culled(c) ? drawn : 0;
    }

    // The tolerances from the rule's own on at which the cluster is drawn; with a fade, at which it
    // may be.
    V3DG_HD BinRange bins(size_t c) const {
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        const BinRange range{own < 0 ? 0 : groups.first_unrefined(own),
                             parent < 0 ? kNumBudgetBins : groups.first_fitting(parent)};
        return range.is_empty() || is_culled(c) ? BinRange{0, 0} : range;
    }
};

// How urgently the page of a group is wanted: above 1 if the cut misses it, at most 1 if it would
// at a smaller tolerance. A fade misses it earlier.
V3DG_HD inline float priority_of(float metric_px2, const SelectRule& rule) {
    const float ratio = metric_px2 * rule.fade.factor / rule.tolerance_px2;
    if (fits(metric_px2, rule)) return ratio <= 1.0f ? ratio : 0.0f;
    return ratio > 1.0f ? ratio : 1.0f + FLT_EPSILON;
}
// Pages are asked for ahead, before the cut misses them, from this priority on.
constexpr float kLeastPriority = 0.5f;

// A page that a cut needs, and how urgently.
struct PageNeed {
    int32_t page;  // -1: none
    float priority;
};

// The page that a cluster which is not culled tells that its instance needs, and with it those
// above; `priority` says how urgently the page of a group does. Once all are resident whose
// priority is above 1, and the pages above them, the cut is the one that is made if every page is:
// a cluster of that has its page, and one that stands in for finer ones asks for theirs. It goes on
// asking once they are there, for all of them may be culled: a page that is needed as long as it is
// absent would come and go without end.
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

// More than rounding can do to a metric, which is compared with what bounds it.
constexpr float kBoundMargin = 1e-3f;

// Whether all the groups above the clusters fit, so that none of the clusters is drawn.
V3DG_HD inline bool parents_fit(const ClusterBounds& bounds, const InstanceView& view,
                                const SelectRule& rule) {
    if (bounds.has_root || rule.footprint == Footprint::paper) return false;
    const float distance = sqrtf(distance2_to(bounds.parents, view)) - bounds.parents.radius;
    return distance > 0.0f && footprint_at(bounds.most_parent_radius, distance * distance, view) *
                                      bounds.most_parent_weight * rule.fade.factor <=
                                  (1.0f - kBoundMargin) * rule.tolerance_px2;
}

// Whether all the clusters have groups of their own that are refined, so that none of them is
// drawn.
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

enum class Tolerances { this_one, from_this_on };

// False only if none of the clusters is drawn at these tolerances. Bounds do not know which pages
// are absent, whose groups fit whatever they say.
V3DG_HD inline bool may_draw(const ClusterTable& table, const ClusterBounds& bounds,
                             const InstanceView& view, const SelectRule& rule,
                             Tolerances tolerances) {
    return !(rule.culls && is_outside(bounds.box, view)) && !parents_fit(bounds, view, rule) &&
           (tolerances == Tolerances::from_this_on || !table.pages.is_whole() ||
            !owns_are_refined(bounds, view, rule));
}

struct ClusterRange {
    uint32_t first, end;
};

// A ball whose radius is at most half of its distance covers between pi and this times pi x2
// steradians.
constexpr float kMostOfPi = 1.08f;
// Far from where float32 loses digits, and from where squares overflow.
constexpr float kLeastRunTolerance = 1e-20f, kLeastRunX2 = 1e-30f, kMostRunDistance = 1e18f;

// Whole runs of clusters outside of which none is drawn at these tolerances, as bounds tell it.
V3DG_HD inline ClusterRange clusters_to_ask(const ClusterTable& table, const ClusterRuns& runs,
                                            const InstanceView& view, const SelectRule& rule,
                                            Tolerances tolerances) {
    const float distance = sqrtf(distance2_to(runs.groups, view));
    const float nearest = distance - runs.groups.radius, farthest = distance + runs.groups.radius;
    const float x2 =
        rule.tolerance_px2 / (float(kPi) * view.px2_per_steradian);  // of the tolerance's ball
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
