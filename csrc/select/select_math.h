#pragma once

// Formulas of selection, compiled without contraction on both halves so that they give the same bits.
//
// Every comparison of a metric with the tolerance goes through fits(), and a cluster is drawn when its own
// group fits and the group above does not: what one test accepts, the other refuses.

#include <cfloat>
#include <cmath>
#include <cstdint>
#include <cstring>

#include "base/span.h"
#include "math/bounds.h"
#include "math/solid_angle.h"

namespace v3dg {

enum class Footprint {
    solid_angle,  // what the ball covers of the sphere around the eye; turning the camera changes nothing
    paper,        // pi r^2 fx fy / depth^2; Yang et al., SIGGRAPH 2025
};

constexpr int kNumPlanes = 5;

// A frustum plane pushed outwards. A point is outside by normal . p + offset, if that is positive.
struct Plane {
    float normal[3], offset;
    // A gaussian's image reaches this much farther, per unit of its box's half depth, than the box itself,
    // because its projection is linearised at its mean.
    float guard;
};

// One camera as one instance sees it: in the instance's own frame and units.
struct InstanceView {
    float eye[3];
    float forward[3];         // unit length
    float px2_per_steradian;  // times the instance's importance
    Plane plane[kNumPlanes];
};

// What selection reads of a bundle: G groups, C clusters. Group -1 is none.
struct ClusterTable {
    Span<const Ball> ball;             // [G] contains the balls of the groups below it
    Span<const float> weight;          // [G] per px2, never decreasing towards the root
    Span<const int32_t> level;         // [G] of the clusters that the group makes, ascending towards the root
    Span<const int32_t> own_group;     // [C] group that made the cluster; -1: always fits
    Span<const int32_t> parent_group;  // [C] group that replaces the cluster; -1: nothing does
    Span<const Box> box;               // [C] what the cluster draws, without the filter
    Span<const int64_t> offset;        // [C + 1] gaussians of each cluster
    Span<const int32_t> top_group;     // groups that no other group replaces
    Span<const int32_t> top_cluster;   // clusters that no group replaces
    Box bounds;                        // of all boxes
    float pad_px;                      // how far the filter reaches, and a pixel
};

constexpr uint64_t kNoBudget = ~uint64_t(0);

struct SelectRule {
    float tolerance_px2;
    Footprint footprint = Footprint::solid_angle;
    bool culls = true;            // drop what lies outside the frustum
    int32_t min_level = 0;        // nothing finer is drawn
    uint64_t budget = kNoBudget;  // most gaussians; the tolerance is raised until they fit
};

V3DG_HD inline float distance2_to(const Ball& ball, const InstanceView& view) {
    const float dx = ball.x - view.eye[0], dy = ball.y - view.eye[1], dz = ball.z - view.eye[2];
    return dx * dx + dy * dy + dz * dz;
}

// Of a ball so far away, squared, from the eye.
V3DG_HD inline float footprint_at(float radius, float distance2, const InstanceView& view) {
    const float x2 = radius * radius / distance2;
    if (!(x2 < 1.0f)) return INFINITY;
    return solid_angle_of_ball(x2) * view.px2_per_steradian;
}

// Screen area that the ball covers, px2. +inf when the eye is inside, or where there is no number.
V3DG_HD inline float footprint_px2(const Ball& ball, const InstanceView& view, Footprint footprint) {
    if (footprint == Footprint::solid_angle) return footprint_at(ball.radius, distance2_to(ball, view), view);
    const float depth = (ball.x - view.eye[0]) * view.forward[0] + (ball.y - view.eye[1]) * view.forward[1] +
                        (ball.z - view.eye[2]) * view.forward[2];
    const float area = float(kPi) * (ball.radius * ball.radius / (depth * depth)) * view.px2_per_steradian;
    return area >= 0.0f ? area : INFINITY;
}

// Screen area, px2, that one gaussian of the clusters made by group g stands for; none where nothing finer
// may be drawn.
V3DG_HD inline float metric_px2(const ClusterTable& table, int32_t g, const InstanceView& view,
                                const SelectRule& rule) {
    if (table.level[g] <= rule.min_level) return 0.0f;
    return footprint_px2(table.ball[g], view, rule.footprint) * table.weight[g];
}

V3DG_HD inline bool fits(const ClusterTable& table, int32_t g, const InstanceView& view,
                         const SelectRule& rule) {
    return metric_px2(table, g, view, rule) <= rule.tolerance_px2;
}

// Where a box lies as seen from one plane, in units of the plane's normal.
struct PlaneSide {
    float nearest, farthest;  // signed distance of the box's innermost and outermost corner
    float reach;              // how far gaussians may reach inwards of the box, and bound on rounding
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
    return {middle - spread, middle + spread, plane.guard * half_depth + 16.0f * FLT_EPSILON * terms};
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

// The tolerances that a budget chooses from: the rule's own, then 2048 to an octave, and infinity. A metric
// belongs to the first of them that it fits; what is no number, to the bin after the last.
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

V3DG_HD inline uint32_t bin_of_group(const ClusterTable& table, int32_t g, const InstanceView& view,
                                     const SelectRule& rule) {
    return bin_of_metric(metric_px2(table, g, view, rule), rule.tolerance_px2);
}

// Whether the clusters that nothing replaces are the cut. The paper's footprint does not grow towards the
// root, so that a group may fail to fit below one that does.
V3DG_HD inline bool top_fits(const ClusterTable& table, const InstanceView& view, const SelectRule& rule) {
    if (rule.footprint == Footprint::paper) return false;
    for (size_t i = 0; i < table.top_group.size; ++i)
        if (!fits(table, table.top_group[i], view, rule)) return false;
    return true;
}

}  // namespace v3dg
