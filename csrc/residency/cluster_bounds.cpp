// Computes bounds of each kClustersOfBounds clusters, and of runs of clusters.

#include "residency/cluster_bounds.h"

#include <algorithm>
#include <cmath>

#include "base/parallel_for.h"

namespace v3dg {

namespace {

// Runs are tested only if radii are at least this large. The square of this value is
// far above the range in which float32 loses precision.
constexpr float kLeastRunRadius = 1e-15f;

// Returns a ball that contains the centres of the balls. If there are no balls, the
// result is at the origin.
Ball ball_of_centers(Span<const Ball> balls) {
    double middle[3] = {0, 0, 0}, radius2 = 0;
    for (const Ball& b : balls) {
        const float center[3] = {b.x, b.y, b.z};
        for (int a = 0; a < 3; ++a) middle[a] += center[a] / static_cast<double>(balls.size);
    }
    const float m[3] = {float(middle[0]), float(middle[1]), float(middle[2])};
    for (const Ball& b : balls) {
        const double d[3] = {double(b.x) - m[0], double(b.y) - m[1], double(b.z) - m[2]};
        radius2 = std::max(radius2, d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    }
    return {.x = m[0],
            .y = m[1],
            .z = m[2],
            .radius = static_cast<float>(std::sqrt(radius2) * (1 + 1e-6))};
}

ClusterBounds bounds_of(const ClusterTable& table, size_t first, size_t last) {
    ClusterBounds bounds{.box = no_box(),
                         .parents = {},
                         .owns = {},
                         .most_parent_radius = 0,
                         .most_parent_weight = 0,
                         .least_own_radius = INFINITY,
                         .least_own_weight = INFINITY,
                         .least_own_level = INT32_MAX,
                         .has_leaf = false,
                         .has_root = false};
    Ball parents[kClustersOfBounds], owns[kClustersOfBounds];
    size_t num_parents = 0, num_owns = 0;
    for (size_t c = first; c < last; ++c) {
        grow(bounds.box, table.box[c]);
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        bounds.has_leaf |= own < 0;
        bounds.has_root |= parent < 0;
        if (own >= 0) {
            owns[num_owns++] = table.ball[own];
            bounds.least_own_radius = std::min(bounds.least_own_radius, table.ball[own].radius);
            bounds.least_own_weight = std::min(bounds.least_own_weight, table.weight[own]);
            bounds.least_own_level = std::min(bounds.least_own_level, table.level[own]);
        }
        if (parent >= 0) {
            parents[num_parents++] = table.ball[parent];
            bounds.most_parent_radius =
                std::max(bounds.most_parent_radius, table.ball[parent].radius);
            bounds.most_parent_weight = std::max(bounds.most_parent_weight, table.weight[parent]);
        }
    }
    bounds.parents = ball_of_centers({parents, num_parents});
    bounds.owns = ball_of_centers({owns, num_owns});
    return bounds;
}

}  // namespace

std::vector<ClusterBounds> bounds_of_clusters(const ClusterTable& table) {
    const size_t count = table.num_clusters();
    std::vector<ClusterBounds> bounds((count + kClustersOfBounds - 1) / kClustersOfBounds);
    parallel_for(bounds.size(), 128, [&](size_t k) {
        const size_t first = k * kClustersOfBounds;
        bounds[k] = bounds_of(table, first, std::min(first + kClustersOfBounds, count));
    });
    return bounds;
}

ClusterRuns runs_of_clusters(const ClusterTable& table) {
    const size_t count = table.num_clusters();
    ClusterRuns runs{};
    // Ends of the runs, last run first, in units of kClustersOfBounds clusters.
    std::vector<size_t> ends;
    size_t left = (count + kClustersOfBounds - 1) / kClustersOfBounds;
    for (size_t size = 1; left > 0; size *= ends.size() > 1 ? 2 : 1) {
        ends.push_back(left);
        left -= ends.size() < kMostRuns ? std::min(size, left) : left;
    }
    runs.count = static_cast<uint32_t>(ends.size());
    for (uint32_t k = 0; k < runs.count; ++k)
        runs.begin[k + 1] = static_cast<uint32_t>(kClustersOfBounds * ends[runs.count - 1 - k]);
    runs.groups = ball_of_centers(table.ball);
    float most_radius = runs.groups.radius, least_radius = INFINITY;
    for (const Ball& ball : table.ball) {
        most_radius = std::max(most_radius, ball.radius);
        least_radius = std::min(least_radius, ball.radius);
    }
    runs.least_distance = least_radius >= kLeastRunRadius ? 2 * most_radius : INFINITY;
    runs.least_level = INT32_MAX;
    for (const int32_t level : table.level) runs.least_level = std::min(runs.least_level, level);
    const auto size_of = [&](int32_t g) {
        return table.ball[g].radius * std::sqrt(table.weight[g]);
    };
    for (uint32_t k = 0; k < runs.count; ++k) {
        float most_parent = 0, least_own = INFINITY;
        for (size_t c = runs.begin[k]; c < std::min<size_t>(count, runs.begin[k + 1]); ++c) {
            const int32_t own = table.own_group[c], parent = table.parent_group[c];
            const float above = parent < 0 ? NAN : size_of(parent);
            if (!(above <= most_parent)) most_parent = std::isnan(most_parent) ? NAN : above;
            least_own = std::min(least_own, own < 0 ? 0 : size_of(own));
        }
        runs.most_parent[k] = most_parent;
        runs.least_own[k] = least_own;
    }
    return runs;
}

}  // namespace v3dg
