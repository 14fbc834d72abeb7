#pragma once

// The state of a budget over consecutive pictures of one camera.

#include <algorithm>
#include <memory>

#include "camera/camera.h"
#include "select/budget_math.h"
#include "select/rule.h"

namespace v3dg {

// The state that consecutive pictures of one camera share: the tolerance of the budget,
// and for how long nothing has moved. A copy is independent.
class BudgetSteps {
  public:
    uint32_t last_bin = kNoBin;  // the state of tolerance_of_budget(), on the host

    // Returns the rule of the next picture, which shows `scene`. A scene that changes
    // becomes another object. Without a fade, earlier pictures have no influence.
    SelectRule next(SelectRule rule, const Eyes& eyes, const std::shared_ptr<const void>& scene) {
        if (!rule.fade.is_on()) return rule;
        const bool is_same_scene = !scene_.owner_before(scene) && !scene.owner_before(scene_);
        const bool is_at_rest = has_begun_ && is_same_scene && rule_ == rule && eyes_ == eyes;
        frames_at_rest_ = is_at_rest ? std::min(frames_at_rest_ + 1, kRestFrames) : 0;
        has_begun_ = true;
        rule_ = rule;
        eyes_ = eyes;
        scene_ = scene;
        rule.pace = BudgetPace::in_steps;
        rule.frames_at_rest = frames_at_rest_;
        return rule;
    }

  private:
    bool has_begun_ = false;
    SelectRule rule_{};
    Eyes eyes_;
    // does not keep the scene alive, but keeps its address from being reused
    std::weak_ptr<const void> scene_;
    int32_t frames_at_rest_ = 0;
};

// Returns body(rule, last_bin) for the next picture of the sequence `steps`, and counts
// the picture unless body throws. If `steps` is null, there is no earlier picture and
// the rule is unchanged.
template <class Body>
auto in_steps(BudgetSteps* steps, const SelectRule& rule, const Eyes& eyes,
              const std::shared_ptr<const void>& scene, const Body& body) {
    BudgetSteps now = steps == nullptr ? BudgetSteps{} : *steps;
    const SelectRule next = steps == nullptr ? rule : now.next(rule, eyes, scene);
    auto result = body(next, &now.last_bin);
    if (steps != nullptr) *steps = now;
    return result;
}

}  // namespace v3dg
