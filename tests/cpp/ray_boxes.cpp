// The boxes of directions and the nearest distances of gaussians, against random points of their
// ellipsoids. Prints what is wrong, if anything.

#include <cmath>
#include <cstdio>
#include <random>

#include "rays/ray_math.h"

using namespace v3dg;

namespace {

std::mt19937 random_bits(1);

double uniform(double low, double high) {
    return std::uniform_real_distribution<double>(low, high)(random_bits);
}

double normal() { return std::normal_distribution<double>()(random_bits); }

// Gaussians of all sizes and shapes, many of them near a pole, some of them around the eye.
Gaussian3d<float> random_gaussian() {
    Gaussian3d<float> g;
    const double distance = exp(uniform(-3, 3));
    const double size = distance * exp(uniform(-9, 0.3));
    double direction[3] = {normal(), normal(), normal()};
    const int place = static_cast<int>(uniform(0, 4));
    if (place == 0)
        for (int a = 0; a < 2; ++a) direction[a] *= exp(uniform(-12, -1));
    if (place == 1) direction[2] *= 0.01;
    const double length = sqrt(direction[0] * direction[0] + direction[1] * direction[1] +
                               direction[2] * direction[2]);
    for (int a = 0; a < 3; ++a) {
        g.mean[a] = static_cast<float>(distance * direction[a] / length);
        g.scale[a] = static_cast<float>(size * exp(2 * normal()));
    }
    for (float& q : g.quat) q = static_cast<float>(normal());
    g.opacity = static_cast<float>(uniform(0.01, 1));
    return g;
}

struct Extent {
    double turn = 0, height = 0;  // of the directions of the points, at most
};

// The distance at which the ray through a point is hit, where the gaussian's value along
// the ray is largest.
double hit_distance(const SeenGaussian<float>& seen, const double p[3]) {
    const double length = sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
    double along_mean = 0, along_ray = 0;
    for (int a = 0; a < 3; ++a) {
        double mean = 0, ray = 0;
        for (int i = 0; i < 3; ++i) {
            mean += double(seen.axis[a][i]) * seen.direction[i];
            ray += double(seen.axis[a][i]) * p[i] / length;
        }
        along_mean += mean * ray / (double(seen.sigma[a]) * seen.sigma[a]);
        along_ray += ray * ray / (double(seen.sigma[a]) * seen.sigma[a]);
    }
    return seen.distance * along_mean / along_ray;
}

// Whether a point of the ellipsoid is in the box.
bool contains(const DirectionBox<float>& box, const double p[3], Extent& extent) {
    const double middle = 0.5 * (double(box.azimuth0) + box.azimuth1);
    const double turn = std::remainder(atan2(p[1], p[0]) - middle, 2 * kPi);
    const double elevation = atan2(p[2], sqrt(p[0] * p[0] + p[1] * p[1]));
    extent.turn = max_of(extent.turn, fabs(turn));
    extent.height =
        max_of(extent.height, fabs(elevation - 0.5 * (double(box.elevation0) + box.elevation1)));
    const bool is_turned = fabs(turn) > 0.5 * (double(box.azimuth1) - box.azimuth0);
    return !is_turned && elevation >= box.elevation0 && elevation <= box.elevation1;
}

}  // namespace

int main() {
    constexpr int kGaussians = 20000, kPoints = 200;
    const ModelView<float> view{.linear = {0, 0, 1.5f, -1.5f, 0, 0, 0, -1.5f, 0},
                                .translation = {},
                                .eye = {},
                                .eye_rest = {}};
    int missed = 0, loose = 0, num_small = 0;
    for (int n = 0; n < kGaussians; ++n) {
        const Gaussian3d<float> g = random_gaussian();
        const SeenGaussian<float> seen = see_gaussian(g, view, 1e-6f, false, false);
        const float reach2 =
            (seen.log2_opacity - float(kLog2MinAlpha)) / float(kFalloffScale * kFalloffScale);
        const DirectionBox<float> box = directions_of(seen, reach2);
        const float nearest = nearest_of(seen, reach2);
        Extent extent;
        bool is_missed = false;
        for (int k = 0; k < kPoints; ++k) {
            const double w[3] = {normal(), normal(), normal()};
            const double scale = sqrt(double(reach2) / (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]));
            double p[3];
            for (int i = 0; i < 3; ++i) {
                p[i] = seen.direction[i];
                for (int a = 0; a < 3; ++a) p[i] += scale * w[a] * seen.sigma[a] * seen.axis[a][i];
                p[i] *= seen.distance;
            }
            const double hit = hit_distance(seen, p);
            const bool is_in_front = hit > 0 && hit < nearest * (1 - 1e-6);
            is_missed = is_missed || is_in_front || !contains(box, p, extent);
        }
        missed += is_missed;
        const double height = double(box.elevation1) - box.elevation0;
        if (height < 0.2 && fabs(seen.direction[2]) < 0.9) {
            ++num_small;
            loose += height > 4 * extent.height + 4e-5;
        }
    }
    if (missed > 0) std::printf("%d of %d boxes miss a point\n", missed, kGaussians);
    if (num_small < kGaussians / 10) std::printf("only %d boxes are small\n", num_small);
    if (loose > num_small / 50) std::printf("%d of %d boxes are loose\n", loose, num_small);
    return 0;
}
