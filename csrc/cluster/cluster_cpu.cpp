// Median split: one task a node, down to a size where tasks cost more than they win.
// Bounding balls: one thread a segment; the centre comes from a small core set of the farthest spheres
// (Badoiu and Clarkson, Smaller core-sets for balls, SODA 2003).

#include "cluster/cluster.h"

#include <algorithm>
#include <vector>

#include "base/parallel_for.h"

namespace v3dg {

int num_halvings(size_t n, size_t cluster_size) {
    int depth = 0;
    for (size_t largest = n; largest > cluster_size; largest = (largest + 1) / 2) ++depth;
    return depth;
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

// Splits points first .. last, the node's 2^depth leaves being leaf .. leaf + 2^depth.
void split_node(IndexedPoint* points, ptrdiff_t first, ptrdiff_t last, int depth, size_t leaf,
                Span<int64_t> order, Span<int64_t> leaf_offset) {
    if (depth == 0) {
        leaf_offset[leaf + 1] = last;
        for (ptrdiff_t i = first; i < last; ++i) order[i] = points[i].index;
        std::sort(order.data + first, order.data + last);
        return;
    }
    const ptrdiff_t middle = first + (last - first + 1) / 2;
    if (middle < last) {
        const int axis = longest_axis(points + first, points + last);
        const auto move = axis == 0 ? move_median<0> : axis == 1 ? move_median<1> : move_median<2>;
        move(points + first, points + middle, points + last);
    }
    const size_t half = size_t(1) << (depth - 1);
#pragma omp task if (last - first > kTaskSize)
    split_node(points, first, middle, depth - 1, leaf, order, leaf_offset);
    split_node(points, middle, last, depth - 1, leaf + half, order, leaf_offset);
}

size_t farthest(const Center& center, const Sphere* spheres, size_t count, double* distance) {
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

constexpr size_t kCoreSize = 24;
constexpr int kCoreSteps = 256;
constexpr double kCoreTolerance = 1e-4;

// Moves `center` towards the centre of the smallest ball around a few spheres; returns its radius.
double center_core(const Sphere* core, size_t count, Center* center) {
    double best_radius;
    Center at = *center;
    size_t far = farthest(at, core, count, &best_radius);
    double radius = best_radius;
    for (int step = 2; step < kCoreSteps; ++step) {
        const Sphere& sphere = core[far];
        const double distance = radius - sphere.radius;
        if (distance <= 0.0) break;                    // concentric: nothing to move towards
        const double move = radius / distance / step;  // the far side of the sphere, not its centre
        at.x += (sphere.x - at.x) * move;
        at.y += (sphere.y - at.y) * move;
        at.z += (sphere.z - at.z) * move;
        far = farthest(at, core, count, &radius);
        if (radius < best_radius) {
            best_radius = radius;
            *center = at;
        }
    }
    return best_radius;
}

// Centre of nearly the smallest ball around the spheres.
Center center_of(const Sphere* spheres, size_t count) {
    Center center{spheres[0].x, spheres[0].y, spheres[0].z};
    if (count == 1) return center;
    double radius;
    size_t far = farthest(center, spheres, count, &radius);
    double best_radius = radius;
    Center best = center;
    Sphere core[kCoreSize] = {spheres[0], spheres[far]};
    for (size_t size = 2;; ++size) {
        const double core_radius = center_core(core, size, &center);
        far = farthest(center, spheres, count, &radius);
        if (radius < best_radius) {
            best_radius = radius;
            best = center;
        }
        if (radius <= core_radius * (1.0 + kCoreTolerance) || size == kCoreSize) return best;
        core[size] = spheres[far];
    }
}

Sphere ball_at(const Center& center, const Sphere* spheres, size_t count, double margin) {
    Sphere ball{float(center.x), float(center.y), float(center.z), 0.0f};
    double radius;
    farthest({ball.x, ball.y, ball.z}, spheres, count, &radius);
    ball.radius = std::max(round_up(radius * (1.0 + margin)), kMinRadius);
    return ball;
}

}  // namespace

void cpu::median_split(Span<const Point> means, int depth, Span<int64_t> order, Span<int64_t> leaf_offset) {
    assert(order.size == means.size && leaf_offset.size == (size_t(1) << depth) + 1);
    std::vector<IndexedPoint> points(means.size);
    const ptrdiff_t count = static_cast<ptrdiff_t>(means.size);
    leaf_offset[0] = 0;
#pragma omp parallel if (count > kTaskSize)
    {
#pragma omp for
        for (ptrdiff_t i = 0; i < count; ++i)
            points[i] = {{means[i].axis[0], means[i].axis[1], means[i].axis[2]}, uint32_t(i)};
#pragma omp single
        split_node(points.data(), 0, count, depth, 0, order, leaf_offset);
    }
}

void cpu::bound_spheres(Span<const Sphere> spheres, Span<const int64_t> offset, double margin,
                        Span<Sphere> ball) {
    parallel_for(ball.size, 16, [&](size_t s) {
        const Sphere* first = spheres.data + offset[s];
        const size_t count = offset[s + 1] - offset[s];
        ball[s] =
            count == 0 ? Sphere{0, 0, 0, kMinRadius} : ball_at(center_of(first, count), first, count, margin);
    });
}

}  // namespace v3dg
