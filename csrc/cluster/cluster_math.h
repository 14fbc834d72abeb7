#pragma once

// Formulas of bounding balls, for the CPU and CUDA.

#include <cmath>
#include <cstddef>

#include "math/bounds.h"

namespace v3dg {

struct Point {
    float axis[3];
};

// The relative margin by which a ball contains the balls below it. It exceeds the
// rounding error of a footprint in float32 (about 1e-6), so that larger balls have
// larger footprints.
constexpr double kNestingMargin = 4e-6;

// The smallest radius of a ball. Its square is a normal number and thus has full
// precision.
constexpr float kMinRadius = 1e-15f;

// Returns the number of points in the left half of a node: half of the node's points,
// rounded up to a multiple of `unit`, but at most all of them.
constexpr size_t left_half(size_t num_points, size_t unit) {
    const size_t num_units = (num_points + unit - 1) / unit;
    const size_t left = (num_units + 1) / 2 * unit;
    return left < num_points ? left : num_points;
}

struct Center {
    double x, y, z;
};

// Returns the distance from `center` to the farthest point of the sphere.
V3DG_HD inline double reach(const Center& center, const Ball& sphere) {
    const double dx = sphere.x - center.x, dy = sphere.y - center.y, dz = sphere.z - center.z;
    return sqrt(dx * dx + dy * dy + dz * dz) + sphere.radius;
}

// The maximum size of the core set. The smallest ball around many spheres is
// approximately the smallest ball around a few of them, the core set. It is found by
// repeatedly adding the sphere that is farthest from the current centre (Badoiu and
// Clarkson, Smaller core-sets for balls, SODA 2003).
constexpr int kCoreSize = 24;
constexpr int kFirstCoreStep = 2, kLastCoreStep = 255;
constexpr double kCoreTolerance = 1e-4;

// Moves the centre of a core set towards the sphere whose farthest point has the
// distance `radius`. Returns false if they are concentric, so that there is no
// direction.
V3DG_HD inline bool move_center(const Ball& farthest, double radius, int step, Center& center) {
    const double distance = radius - farthest.radius;
    if (distance <= 0.0) return false;
    // Move the centre towards the farthest point of the sphere, not towards its centre.
    const double move = radius / distance / step;
    center.x += (farthest.x - center.x) * move;
    center.y += (farthest.y - center.y) * move;
    center.z += (farthest.z - center.z) * move;
    return true;
}

// Returns whether the core set is full, or its ball contains all spheres within the
// tolerance.
V3DG_HD inline bool core_suffices(double radius, double core_radius, int core_size) {
    return radius <= core_radius * (1.0 + kCoreTolerance) || core_size == kCoreSize;
}

// Returns a float32 ball at the centre, with radius 0.
V3DG_HD inline Ball ball_at(const Center& center) {
    return {static_cast<float>(center.x), static_cast<float>(center.y),
            static_cast<float>(center.z), 0.0f};
}
V3DG_HD inline Center center_of(const Ball& ball) { return {ball.x, ball.y, ball.z}; }

V3DG_HD inline float radius_of_ball(double farthest_reach, double margin) {
    const float radius = round_up(farthest_reach * (1.0 + margin));
    return radius > kMinRadius ? radius : kMinRadius;
}

}  // namespace v3dg
