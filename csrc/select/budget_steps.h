#pragma once

#include <algorithm>
#include <memory>

#include "math/camera.h"
#include "select/select_math.h"

namespace v3dg {

// What pictures that follow each other, of one camera, know of the ones before: where the tolerance
// of a budget is, and for how long nothing has moved. A copy goes on by itself.
class BudgetSteps {
  public:
    uint32_t last_bin = kNoBin;  // on the host, what tolerance_of_budget() keeps

    // The rule of the next picture, which shows `scene`: an object that stays as it is, and that a
    // change makes another of. Without a fade nothing follows from the pictures before.
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
    std::weak_ptr<const void> scene_;  // keeps no scene, and no other one can take its place
    int32_t frames_at_rest_ = 0;
};

// What body(rule, last_bin) returns for the next of the pictures that `steps` knows, which count it
// unless it throws. Null: nothing came before, and the rule is as it is.
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
