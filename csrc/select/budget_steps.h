#pragma once

// The state that a budget keeps between consecutive pictures of one camera.

#include <algorithm>
#include <memory>

#include "camera/camera.h"
#include "select/budget_math.h"
#include "select/rule.h"

namespace v3dg {

// The last tolerance of a budget, and the number of pictures for which nothing has
// moved. Copies are independent.
class BudgetSteps {
  public:
    // State of tolerance_of_budget() if it is kept on the host.
    uint32_t last_bin = kNoBin;

    // Returns the rule for the next picture. `scene` must be a new object after each
    // change of the scene. Without a fade, the rule is returned unchanged.
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
    // A weak pointer does not keep the scene alive, but ensures that its address is not
    // reused.
    std::weak_ptr<const void> scene_;
    int32_t frames_at_rest_ = 0;
};

// Calls body(rule, last_bin) for the next picture of a sequence, and returns its
// result. `steps` is the state of the sequence; if body throws, it is not changed. If
// `steps` is null, there is only one picture, and the rule is not changed.
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
