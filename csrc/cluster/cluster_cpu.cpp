// Clustering on the CPU. The median split first halves all large nodes of a level in
// parallel, then those of the next level. A single thread splits a small node down to
// its leaves. Each bounding ball is computed by one thread.

#include "cluster/cluster.h"

#include <algorithm>
#include <vector>

#include "base/parallel_for.h"

namespace v3dg {

int num_halvings(size_t n, size_t cluster_size) {
    int depth = 0;
    for (size_t largest = n; largest > cluster_size; largest = left_half(largest, 1)) ++depth;
    return depth;
}

void halve_segments(Span<const int64_t> offset, int depth, size_t unit, Span<int64_t> leaf_offset) {
    const size_t leaves = size_t(1) << depth;
    assert(leaf_offset.size == (offset.size - 1) * leaves + 1);
    for (size_t s = 0; s < offset.size; ++s) leaf_offset[s * leaves] = offset[s];
    for (size_t width = leaves; width > 1; width /= 2)
        for (size_t leaf = 0; leaf + 1 < leaf_offset.size; leaf += width) {
            const int64_t first = leaf_offset[leaf], last = leaf_offset[leaf + width];
            leaf_offset[leaf + width / 2] =
                first + static_cast<int64_t>(left_half(static_cast<size_t>(last - first), unit));
        }
}

namespace {

struct IndexedPoint {
    float axis[3];
    uint32_t index;
};

// A node with at most this many points is split by a single thread.
constexpr ptrdiff_t kTaskSize = 16384;

// The points of a node, which has 2^depth leaves.
struct Node {
    ptrdiff_t first = 0, last = 0;
    int depth = 0;

    ptrdiff_t size() const { return last - first; }
};

int longest_axis(const IndexedPoint* first, const IndexedPoint* last) {
    float lo[3], hi[3];
    for (int a = 0; a < 3; ++a) lo[a] = hi[a] = first->axis[a];
    for (const IndexedPoint* p = first; p != last; ++p)
        for (int a = 0; a < 3; ++a) {
            lo[a] = std::min(lo[a], p->axis[a]);
            hi[a] = std::max(hi[a], p->axis[a]);
        }
    int longest = 0;
    for (int a = 1; a < 3; ++a)
        if (hi[a] - lo[a] > hi[longest] - lo[longest]) longest = a;
    return longest;
}

template <int kAxis>
void move_median(IndexedPoint* first, IndexedPoint* middle, IndexedPoint* last) {
    std::nth_element(first, middle, last, [](const IndexedPoint& a, const IndexedPoint& b) {
        return a.axis[kAxis] != b.axis[kAxis] ? a.axis[kAxis] < b.axis[kAxis] : a.index < b.index;
    });
}

// Moves the lower half of a node's points to its front. Returns the end of that half.
ptrdiff_t halve_node(IndexedPoint* points, const Node& node, size_t unit) {
    const auto size = static_cast<size_t>(node.size());
    const ptrdiff_t middle = node.first + static_cast<ptrdiff_t>(left_half(size, unit));
    if (middle < node.last) {
        const int axis = longest_axis(points + node.first, points + node.last);
        const auto move = axis == 0 ? move_median<0> : axis == 1 ? move_median<1> : move_median<2>;
        move(points + node.first, points + middle, points + node.last);
    }
    return middle;
}

// Splits a node into its leaves.
void split_node(IndexedPoint* points, const Node& node, size_t unit, int64_t* order) {
    if (node.depth == 0) {
        for (ptrdiff_t i = node.first; i < node.last; ++i) order[i] = points[i].index;
        std::sort(order + node.first, order + node.last);
        return;
    }
    const ptrdiff_t middle = halve_node(points, node, unit);
    split_node(points, {node.first, middle, node.depth - 1}, unit, order);
    split_node(points, {middle, node.last, node.depth - 1}, unit, order);
}

// Splits small nodes into their leaves, and large ones into two nodes, which it
// returns.
std::vector<Node> split_level(IndexedPoint* points, const std::vector<Node>& nodes, size_t unit,
                              int64_t* order) {
    std::vector<Node> halves(2 * nodes.size());
    parallel_for(nodes.size(), 1, [&](size_t n) {
        const Node& node = nodes[n];
        if (node.depth == 0 || node.size() <= kTaskSize) {
            split_node(points, node, unit, order);
            return;
        }
        const ptrdiff_t middle = halve_node(points, node, unit);
        halves[2 * n] = {node.first, middle, node.depth - 1};
        halves[2 * n + 1] = {middle, node.last, node.depth - 1};
    });
    std::erase_if(halves, [](const Node& node) { return node.size() == 0; });
    return halves;
}

size_t farthest(const Center& center, const Ball* spheres, size_t count, double* distance) {
    size_t best = 0;
    double best_distance = -1.0;
    for (size_t i = 0; i < count; ++i) {
        const double d = reach(center, spheres[i]);
        if (d > best_distance) {
            best_distance = d;
            best = i;
        }
    }
    *distance = best_distance;
    return best;
}

// Moves `center` towards the centre of the smallest ball around a core set. Returns the
// radius of that ball.
double center_core(const Ball* core, size_t count, Center* center) {
    double best_radius;
    Center place = *center;
    size_t far = farthest(place, core, count, &best_radius);
    double radius = best_radius;
    for (int step = kFirstCoreStep; step <= kLastCoreStep; ++step) {
        if (!move_center(core[far], radius, step, place)) break;
        far = farthest(place, core, count, &radius);
        if (radius < best_radius) {
            best_radius = radius;
            *center = place;
        }
    }
    return best_radius;
}

// Returns the centre of an approximately smallest ball around the spheres.
Center center_of(const Ball* spheres, size_t count) {
    Center center = center_of(spheres[0]);
    if (count == 1) return center;
    double radius;
    size_t far = farthest(center, spheres, count, &radius);
    double best_radius = radius;
    Center best = center;
    Ball core[kCoreSize] = {spheres[0], spheres[far]};
    for (int size = 2;; ++size) {
        const double core_radius = center_core(core, size, &center);
        far = farthest(center, spheres, count, &radius);
        if (radius < best_radius) {
            best_radius = radius;
            best = center;
        }
        if (core_suffices(radius, core_radius, size)) return best;
        core[size] = spheres[far];
    }
}

}  // namespace

void cpu::median_split(Span<const Point> means, Span<const int64_t> offset, int depth, size_t unit,
                       Span<int64_t> order, Span<int64_t> leaf_offset) {
    assert(order.size == means.size);
    halve_segments(offset, depth, unit, leaf_offset);
    std::vector<IndexedPoint> points(means.size);
    parallel_for(means.size, kTaskSize, [&](size_t i) {
        points[i] = {{means[i].axis[0], means[i].axis[1], means[i].axis[2]}, uint32_t(i)};
    });
    std::vector<Node> nodes;
    for (size_t s = 0; s + 1 < offset.size; ++s) nodes.push_back({offset[s], offset[s + 1], depth});
    while (!nodes.empty()) nodes = split_level(points.data(), nodes, unit, order.data);
}

void cpu::bound_spheres(Span<const Ball> spheres, Span<const int64_t> offset, double margin,
                        Span<Ball> ball) {
    parallel_for(ball.size, 16, [&](size_t s) {
        const Ball* first = spheres.data + offset[s];
        const size_t count = offset[s + 1] - offset[s];
        ball[s] = {0, 0, 0, kMinRadius};
        if (count == 0) return;
        ball[s] = ball_at(center_of(first, count));
        double radius;
        farthest(center_of(ball[s]), first, count, &radius);
        ball[s].radius = radius_of_ball(radius, margin);
    });
}

}  // namespace v3dg
