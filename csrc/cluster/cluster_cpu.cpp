// Clustering on the CPU. The median split processes segments in parallel, and starts a
// task per node, down to a size at which tasks cost more than they gain. A bounding
// ball is computed by one thread.

#include "base/threads.h"
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

constexpr ptrdiff_t kTaskSize = 16384;

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

// Splits points `first` to `last` into the 2^depth leaves of a node. All arguments are
// plain values: LLVM's OpenMP, which the thread sanitizer requires (.ci/sanitize), does
// not copy other types into a task that runs immediately.
void split_node(IndexedPoint* points, ptrdiff_t first, ptrdiff_t last, int depth, size_t unit,
                int64_t* order) {
    if (depth == 0) {
        for (ptrdiff_t i = first; i < last; ++i) order[i] = points[i].index;
        std::sort(order + first, order + last);
        return;
    }
    const ptrdiff_t middle =
        first + static_cast<ptrdiff_t>(left_half(static_cast<size_t>(last - first), unit));
    if (middle < last) {
        const int axis = longest_axis(points + first, points + last);
        const auto move = axis == 0 ? move_median<0> : axis == 1 ? move_median<1> : move_median<2>;
        move(points + first, points + middle, points + last);
    }
#pragma omp task if (last - first > kTaskSize)
    split_node(points, first, middle, depth - 1, unit, order);
    split_node(points, middle, last, depth - 1, unit, order);
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
    const ptrdiff_t count = static_cast<ptrdiff_t>(means.size);
    const ptrdiff_t num_segments = static_cast<ptrdiff_t>(offset.size) - 1;
#pragma omp parallel if (count > kTaskSize) num_threads(most_threads())
    {
#pragma omp for
        for (ptrdiff_t i = 0; i < count; ++i)
            points[i] = {{means[i].axis[0], means[i].axis[1], means[i].axis[2]}, uint32_t(i)};
#pragma omp for schedule(dynamic, 1)
        for (ptrdiff_t s = 0; s < num_segments; ++s)
            split_node(points.data(), offset[s], offset[s + 1], depth, unit, order.data);
    }
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
