#pragma once

// The rule of a cut: tolerance, footprint, budget and fade.

#include <cstdint>

#include "base/host_device.h"

namespace v3dg {

// How the screen area of a ball is measured.
enum class Footprint {
    solid_angle,  // the solid angle of the ball, so turning the camera changes nothing
    paper,        // pi r^2 fx fy / depth^2, for pinholes only; Yang et al., SIGGRAPH 2025
};

// The budget of a rule without one.
constexpr uint64_t kNoBudget = ~uint64_t(0);

// If a metric is within this factor of the tolerance, both of two levels are drawn,
// with weights.
struct Fade {
    float factor = 1.0f, inverse = 1.0f;

    V3DG_HD bool is_on() const { return factor > 1.0f; }
    bool operator==(const Fade& other) const {
        return factor == other.factor && inverse == other.inverse;
    }
};

// How the tolerance that meets a budget is chosen.
enum class BudgetPace {
    at_once,  // from one view alone
    // also from the tolerance of the frame before, so that slow motion causes no leaps
    // (budget_steps.h)
    in_steps,
    again,  // for a frame that is drawn again: no step, unless the budget requires one
};

// The requirements that a cut fulfils.
struct SelectRule {
    float tolerance_px2;
    Footprint footprint = Footprint::solid_angle;
    bool culls = true;            // leave out what lies outside of the frustum
    int32_t min_level = 0;        // finer levels are not drawn
    uint64_t budget = kNoBudget;  // most gaussians; the tolerance is raised until the cut fits
    BudgetPace pace = BudgetPace::at_once;
    int32_t frames_at_rest = 0;  // in steps: number of frames, including this one, without motion
    Fade fade = {};  // off with the paper's footprint, which may decrease towards the root
    // with a fade: the number of the frame, from which the fade of a pool's pages
    // follows
    int32_t frame = 0;

    bool operator==(const SelectRule& o) const {
        return tolerance_px2 == o.tolerance_px2 && footprint == o.footprint && culls == o.culls &&
               min_level == o.min_level && budget == o.budget && pace == o.pace &&
               frames_at_rest == o.frames_at_rest && fade == o.fade && frame == o.frame;
    }
};

}  // namespace v3dg
