#pragma once

// The environments of a scene. Each instance belongs to one environment or to all, and
// a camera sees the instances of its environment and the shared ones.

#include <algorithm>
#include <cstdint>
#include <vector>

#include "base/span.h"

namespace v3dg {

constexpr int32_t kShared = -1;  // as an instance's environment: all see it
constexpr int32_t kMostEnvironment = (1 << 24) - 1;
constexpr int32_t kSeesAll = -2;  // as a camera's environment: it sees all instances

// The instances that a camera sees have slots: first the shared ones, then those of its
// environment, both in ascending order. Instance i has slot i for a camera that sees
// all. I instances, E environments.
struct EnvironmentTable {
    Span<const int32_t> order;  // [I] instances: the shared ones, then those of each environment
    Span<const int32_t> begin;  // [E + 1] where the instances of each environment begin

    V3DG_HD int32_t num_environments() const { return static_cast<int32_t>(begin.size) - 1; }
    // Whether a camera may belong to the environment, or see the shared instances only.
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
    // `environment` is that of each instance, at least kShared.
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
