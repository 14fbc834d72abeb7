#pragma once

// The rule of a cut: tolerance, footprint, budget and fade.

#include <cstdint>

#include "base/host_device.h"

namespace v3dg {

// How the screen area of a ball is measured.
enum class Footprint {
    // The ball's solid angle. It does not change when the camera rotates.
    solid_angle,
    paper,  // pi r² fx fy / depth², only for pinhole cameras (Yang et al., SIGGRAPH
            // 2025)
};

// The value of SelectRule::budget that means no limit.
constexpr uint64_t kNoBudget = ~uint64_t(0);

// A fade. If a group's metric is within `factor` of the tolerance, both its finer and
// its coarser clusters are drawn, with weights that add up to 1.
struct Fade {
    float factor = 1.0f, inverse = 1.0f;

    V3DG_HD bool is_on() const { return factor > 1.0f; }
    bool operator==(const Fade& other) const {
        return factor == other.factor && inverse == other.inverse;
    }
};

// How a budget determines the tolerance.
enum class BudgetPace {
    at_once,  // The tolerance depends only on the current view.
    // The tolerance depends on the current view and on the tolerance of the last frame,
    // so that slow motion causes no sudden change (budget_steps.h).
    in_steps,
    // The tolerance is kept unless the cut exceeds the budget. Used for drawing a frame
    // again.
    again,
};

// The conditions that a cut satisfies.
struct SelectRule {
    float tolerance_px2;
    Footprint footprint = Footprint::solid_angle;
    bool culls = true;      // whether to omit clusters outside the frustum
    int32_t min_level = 0;  // finer levels are not drawn
    // Maximum number of gaussians. If the cut has more, the tolerance is raised.
    uint64_t budget = kNoBudget;
    BudgetPace pace = BudgetPace::at_once;
    // For BudgetPace::in_steps: the number of frames without motion, including this
    // one.
    int32_t frames_at_rest = 0;
    Fade fade = {};  // must be off with Footprint::paper
    // For cuts with a fade: the index of the frame, which determines how far pages have
    // faded in.
    int32_t frame = 0;

    bool operator==(const SelectRule& o) const {
        return tolerance_px2 == o.tolerance_px2 && footprint == o.footprint && culls == o.culls &&
               min_level == o.min_level && budget == o.budget && pace == o.pace &&
               frames_at_rest == o.frames_at_rest && fade == o.fade && frame == o.frame;
    }
};

}  // namespace v3dg
