// Checks the properties of tables one after another, and reports the first wrong row.

#include "cluster/check_tables.h"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <type_traits>
#include <vector>

#include "cluster/cluster_math.h"

namespace v3dg {

namespace {

// Tolerance for values that two programs computed in double precision with different
// rounding.
constexpr double kRounding = 1e-9;

template <class Expected>
std::string text_of(const Expected& expected, size_t row) {
    if constexpr (std::is_invocable_v<Expected, size_t>)
        return expected(row);
    else
        return expected;
}

// Throws for the first row for which holds(row) is false. `expected` is a text, or a
// function that returns the text for a row.
template <class Holds, class Expected>
void check_rows(const char* table, size_t count, const Holds& holds, const Expected& expected) {
    for (size_t row = 0; row < count; ++row)
        if (!holds(row)) throw TableFault{table, static_cast<int64_t>(row), text_of(expected, row)};
}

// Throws for the first row whose value is smaller than the one before.
template <class Value>
void check_ascends(const char* table, size_t count, const Value& value, const char* expected) {
    check_rows(
        table, count, [&](size_t i) { return i == 0 || value(i) >= value(i - 1); }, expected);
}

bool is_finite(Span<const float> values, size_t row, size_t width) {
    return std::all_of(values.data + row * width, values.data + (row + 1) * width,
                       [](float value) { return std::isfinite(value); });
}

class Checker {
  public:
    explicit Checker(const GivenTables& tables)
        : t_(tables),
          num_clusters_(tables.level.size),
          num_groups_(tables.parent.size),
          last_level_(num_clusters_ ? tables.level[num_clusters_ - 1] : 0) {}

    void check_offsets(int64_t num_gaussians) const {
        if (t_.offset[0] != 0) throw TableFault{"clusters.offset", 0, "0"};
        check_ascends(
            "clusters.offset", t_.offset.size, [&](size_t i) { return t_.offset[i]; },
            "offsets that never decrease");
        if (t_.offset[num_clusters_] != num_gaussians)
            throw TableFault{"clusters.offset", -1, std::to_string(num_gaussians) + " gaussians"};
        if (num_clusters_ && t_.level[0] != 0) throw TableFault{"clusters.level", 0, "0"};
        check_rows(
            "clusters.level", num_clusters_,
            [&](size_t c) {
                const int64_t step = c == 0 ? 0 : int64_t{t_.level[c]} - t_.level[c - 1];
                return step == 0 || step == 1;
            },
            "the level before, or one more");
    }

    // Checks that the groups form trees. A group replaces the clusters of one page, and
    // makes clusters of the next level. All of these have the same parent.
    void check_tree() const {
        check_links("clusters.own_group", t_.own_group, t_.level, 0, 0);
        check_links("clusters.parent_group", t_.parent_group, t_.level, last_level_, 1);
        check_rows(
            "groups.level", num_groups_,
            [&](size_t g) { return t_.group_level[g] >= 1 && t_.group_level[g] <= last_level_; },
            "1 to " + std::to_string(last_level_));
        check_links("groups.parent", t_.parent, t_.group_level, last_level_, 1);
        // Clusters of the last level have no parent. They come last, so treat their
        // parent as group num_groups_.
        check_ascends(
            "clusters.parent_group", num_clusters_,
            [&](size_t c) {
                return t_.level[c] == last_level_ ? static_cast<int64_t>(num_groups_)
                                                  : t_.parent_group[c];
            },
            "parents in ascending order, so that groups are in the order of the clusters they "
            "replace");
        check_is_used("own_group", t_.own_group);
        check_is_used("parent_group", t_.parent_group);
        const auto of_own = [&](size_t c) {
            return t_.own_group[c] >= 0 ? t_.parent[t_.own_group[c]] : t_.parent_group[c];
        };
        check_rows(
            "clusters.parent_group", num_clusters_,
            [&](size_t c) { return t_.parent_group[c] == of_own(c); },
            [&](size_t c) { return std::to_string(of_own(c)) + ", its own group's parent"; });
    }

    void check_values() const {
        const Span<const float> corners{reinterpret_cast<const float*>(t_.box.data),
                                        6 * num_clusters_};
        check_rows(
            "clusters.box", num_clusters_, [&](size_t c) { return is_finite(corners, c, 6); },
            "finite numbers");
        check_rows(
            "clusters.box", num_clusters_,
            [&](size_t c) {
                const Box& box = t_.box[c];
                const bool is_empty = t_.offset[c + 1] == t_.offset[c];
                return is_empty || std::equal(box.lo, box.lo + 3, box.hi, std::less_equal<>());
            },
            "a lower corner not above the upper");
        check_rows(
            "clusters.filter_px2", num_clusters_,
            [&](size_t c) { return std::isfinite(t_.filter_px2[c]) && t_.filter_px2[c] >= 0; },
            "0 or more");
        check_rows(
            "clusters.antialiased", num_clusters_, [&](size_t c) { return t_.antialiased[c] <= 1; },
            "0 or 1");
        const Span<const float> balls{reinterpret_cast<const float*>(t_.ball.data),
                                      4 * num_groups_};
        check_rows(
            "groups.ball", num_groups_, [&](size_t g) { return is_finite(balls, g, 4); },
            "finite numbers");
        check_rows(
            "groups.ball", num_groups_, [&](size_t g) { return t_.ball[g].radius >= kMinRadius; },
            "a radius of " + shown(kMinRadius) + " or more");
        check_rows(
            "groups.weight", num_groups_,
            [&](size_t g) { return std::isfinite(t_.weight[g]) && t_.weight[g] > 0; },
            "a positive number");
        check_rows(
            "groups.error", num_groups_,
            [&](size_t g) {
                return std::none_of(t_.error.data + 2 * g, t_.error.data + 2 * g + 2,
                                    [](float error) { return error < 0 || std::isinf(error); });
            },
            "0 or more, or NaN if unknown");
    }

    void check_nesting() const {
        const auto needed = [&](size_t g) {
            const Ball &below = t_.ball[g], &above = t_.ball[t_.parent[g]];
            const double x = double(below.x) - above.x, y = double(below.y) - above.y,
                         z = double(below.z) - above.z;
            return (std::sqrt(x * x + y * y + z * z) + below.radius) * (1 + kNestingMargin);
        };
        check_rows(
            "groups.ball", num_groups_,
            [&](size_t g) {
                return t_.parent[g] < 0 ||
                       t_.ball[t_.parent[g]].radius >= needed(g) * (1 - kRounding);
            },
            [&](size_t g) {
                return "a ball inside the ball of group " + std::to_string(t_.parent[g]) +
                       ", whose radius must be at least " + shown(needed(g));
            });
        check_rows(
            "groups.weight", num_groups_,
            [&](size_t g) { return t_.parent[g] < 0 || t_.weight[t_.parent[g]] >= t_.weight[g]; },
            "at most the weight of the group above");
    }

  private:
    // Checks the groups that rows refer to. Rows of level `without` must not refer to
    // any group. The group of any other row must be `above` levels above the row's
    // level.
    void check_links(const char* table, Span<const int32_t> links, Span<const int32_t> level,
                     int32_t without, int above) const {
        const auto wanted = [&](size_t row) { return int64_t{level[row]} + above; };
        check_rows(
            table, links.size,
            [&](size_t row) {
                const int32_t link = links[row];
                if (level[row] == without) return link == -1;
                const bool is_inside = link >= 0 && static_cast<size_t>(link) < num_groups_;
                return is_inside && t_.group_level[link] == wanted(row);
            },
            [&](size_t row) {
                return level[row] == without ? "-1"
                                             : "a group of level " + std::to_string(wanted(row));
            });
    }

    void check_is_used(const std::string& name, Span<const int32_t> links) const {
        std::vector<uint8_t> is_used(num_groups_, 0);
        for (const int32_t link : links)
            if (link >= 0) is_used[link] = 1;
        check_rows(
            "groups", num_groups_, [&](size_t g) { return is_used[g] != 0; },
            "a cluster that has this group as " + name);
    }

    static std::string shown(double number) {
        char text[32];
        std::snprintf(text, sizeof text, "%.9g", number);
        return text;
    }

    const GivenTables& t_;
    size_t num_clusters_, num_groups_;
    int32_t last_level_;
};

}  // namespace

void check_tables(const GivenTables& tables, int64_t num_gaussians) {
    const Checker checker(tables);
    checker.check_offsets(num_gaussians);
    checker.check_tree();
    checker.check_values();
    checker.check_nesting();
}

}  // namespace v3dg
