#pragma once

// The environments of a scene. Each instance belongs to one environment, or is shared
// by all. A camera sees the instances of its environment and the shared instances.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "base/span.h"

namespace v3dg {

constexpr int32_t kShared = -1;  // value for an instance that all cameras see
constexpr int32_t kMostEnvironment = (1 << 24) - 1;
constexpr int32_t kSeesAll = -2;  // value for a camera that sees all instances

// Numbers the instances that a camera sees: each has a slot. The shared instances come
// first, then those of the camera's environment, both in ascending order. For a camera
// that sees all instances, instance i has slot i. There are I instances and E
// environments.
struct EnvironmentTable {
    // [I] the shared instances, then the instances of each environment
    Span<const int32_t> order;
    // [E + 1] the index in `order` at which each environment begins; the last element
    // is the end
    Span<const int32_t> begin;

    V3DG_HD int32_t num_environments() const { return static_cast<int32_t>(begin.size) - 1; }
    // Returns whether a camera may have the value `environment`. Valid values are the
    // environments of the scene, kShared (only the shared instances) and kSeesAll.
    V3DG_HD bool has(int32_t environment) const {
        return environment >= kSeesAll && environment < num_environments();
    }
    V3DG_HD int32_t num_slots(int32_t environment) const {
        if (environment == kSeesAll) return static_cast<int32_t>(order.size);
        if (environment == kShared) return begin[0];
        return begin[0] + begin[environment + 1] - begin[environment];
    }
    V3DG_HD int32_t instance_of(int32_t environment, int32_t slot) const {
        if (environment == kSeesAll) return slot;
        return slot < begin[0] ? order[slot] : order[begin[environment] + slot - begin[0]];
    }
};

// An EnvironmentTable on the host.
class Environments {
  public:
    // `environment` has the environment of each instance, or kShared.
    explicit Environments(Span<const int32_t> environment) : order_(environment.size) {
        int32_t count = 0;
        for (const int32_t e : environment) count = std::max(count, e + 1);
        std::vector<int32_t> next(size_t(count) + 2, 0);
        for (const int32_t e : environment) ++next[size_t(e) + 2];
        for (size_t e = 1; e < next.size(); ++e) next[e] += next[e - 1];
        begin_.assign(next.begin() + 1, next.end());
        for (size_t i = 0; i < environment.size; ++i)
            order_[next[size_t(environment[i]) + 1]++] = static_cast<int32_t>(i);
    }

    EnvironmentTable table() const {
        return {.order = {order_.data(), order_.size()}, .begin = {begin_.data(), begin_.size()}};
    }

  private:
    std::vector<int32_t> order_, begin_;
};

}  // namespace v3dg
