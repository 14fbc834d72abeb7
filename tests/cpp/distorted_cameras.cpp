// The distorted camera models against finite differences, and what culling and selection rely on
// against random gaussians. Prints what is wrong, if anything.

#include <cmath>
#include <cstdio>
#include <random>

#include "camera/camera.h"
#include "project/project_math.h"

using namespace v3dg;

namespace {

int failures = 0;
std::mt19937 random_bits(1);

double uniform(double low, double high) {
    return std::uniform_real_distribution<double>(low, high)(random_bits);
}

struct Named {
    const char* name;
    Intrinsics<double> camera;
};

std::vector<Named> cameras() {
    const Pinhole<double> image{.fx = 310,
                                .fy = 290,
                                .cx = 330,
                                .cy = 225,
                                .width = 640,
                                .height = 480,
                                .near_depth = 0.05};
    const Pinhole<double> wide{.fx = 170,
                               .fy = 180,
                               .cx = 300,
                               .cy = 250,
                               .width = 640,
                               .height = 480,
                               .near_depth = 0.05};
    const Pinhole<double> part{.fx = 310,
                               .fy = 290,
                               .cx = -100,
                               .cy = 225,
                               .width = 320,
                               .height = 240,
                               .near_depth = 0.05};
    const double barrel[8] = {-0.18, 0.03, 0, 0, 0, 0, 1e-3, -2e-3};
    const double pincushion[8] = {0.12, 0.04, 0.01, 0, 0, 0, -1e-3, 1e-3};
    const double rational[8] = {0.3, 0.02, -0.001, 0.5, 0.05, 0.002, 3e-4, 2e-4};
    const double folding[8] = {-0.35, 0, 0, 0, 0, 0, 0, 0};
    const double zeros[8] = {};
    const double fisheye[4] = {0.05, -0.01, 0.002, -0.0005};
    const double strong[4] = {-0.08, 0, 0, 0};
    return {{"barrel", intrinsics_of_opencv(image, barrel)},
            {"pincushion", intrinsics_of_opencv(image, pincushion)},
            {"pincushion, part", intrinsics_of_opencv(part, pincushion)},
            {"rational", intrinsics_of_opencv(image, rational)},
            {"folding", intrinsics_of_opencv(image, folding)},
            {"no distortion", intrinsics_of_opencv(image, zeros)},
            {"fisheye", intrinsics_of_fisheye(image, fisheye)},
            {"wide fisheye", intrinsics_of_fisheye(wide, zeros)},
            {"folding fisheye", intrinsics_of_fisheye(wide, strong)}};
}

// Returns a direction of unit length, up to an angle from the axis.
void set_direction(double most_angle, double p[3]) {
    const double angle = most_angle * std::sqrt(uniform(0, 1)), turn = uniform(0, 2 * kPi);
    p[0] = std::sin(angle) * std::cos(turn);
    p[1] = std::sin(angle) * std::sin(turn);
    p[2] = std::cos(angle);
}

bool is_drawn(const Intrinsics<double>& camera, const double p[3]) {
    return camera.depth_of(p) >= camera.near_depth;
}

void expect(bool holds, const Named& named, const char* property, double got, double wanted) {
    if (holds || ++failures > 20) return;
    std::printf("%s: %s: expected %.9g, got %.9g\n", named.name, property, wanted, got);
}

// ---- the Jacobian, inside of the image

void check_jacobian(const Named& named) {
    const auto& camera = named.camera;
    for (int round = 0; round < 2000; ++round) {
        double p[3], u, v;
        set_direction(round % 10 == 0 ? 0.02 : 2.9, p);
        const double distance = uniform(0.1, 5);
        for (double& x : p) x *= distance;
        if (!is_drawn(camera, p)) continue;
        const auto at = camera.linearized(camera.limits(), p);
        camera.to_pixel(at, p, u, v);
        if (u < 0 || v < 0 || u > camera.width || v > camera.height) continue;
        for (int k = 0; k < 3; ++k) {
            double after[3] = {p[0], p[1], p[2]}, before[3] = {p[0], p[1], p[2]}, u1, v1, u0, v0;
            const double step = 1e-6 * distance;
            after[k] += step;
            before[k] -= step;
            camera.to_pixel(camera.linearized(camera.limits(), after), after, u1, v1);
            camera.to_pixel(camera.linearized(camera.limits(), before), before, u0, v0);
            const double du = (u1 - u0) / (2 * step), dv = (v1 - v0) / (2 * step);
            expect(std::fabs(du - at.j1[k]) < 1e-5 * (1 + 300 / distance), named, "Jacobian of u",
                   at.j1[k], du);
            expect(std::fabs(dv - at.j2[k]) < 1e-5 * (1 + 300 / distance), named, "Jacobian of v",
                   at.j2[k], dv);
        }
    }
}

// ---- gradients, also where the Jacobian is clamped, and near the axis

constexpr double kFilter = 0.3;
const ModelView<double> kView{{1, 0, 0, 0, 1, 0, 0, 0, 1}, {}, {}, {}};

template <class C>
double loss_of(const Gaussian3d<double>& g, const C& camera) {
    Projection<double, C> s;
    to_view(kView, g.mean, s.p);
    const Ellipse<double> e = project_gaussian(g, kView, camera, kFilter, true, s);
    return 0.3 * e.u - 0.2 * e.v + 500 * e.l11 + 700 * e.l12 - 300 * e.l22 + 2 * e.log2_opacity +
           5 * e.depth;
}

template <class C>
void check_gradients(const Named& named, const C& camera) {
    for (int round = 0; round < 300; ++round) {
        Gaussian3d<double> g{{}, {0.9, 0.1, -0.3, 0.2}, {0.2, 0.05, 0.1}, 0.6};
        set_direction(round % 5 == 0 ? 0.03 : 2.9, g.mean);
        for (double& x : g.mean) x *= 3;
        if (!is_drawn(named.camera, g.mean)) continue;
        Projection<double, C> s;
        to_view(kView, g.mean, s.p);
        const Ellipse<double> e = project_gaussian(g, kView, camera, kFilter, true, s);
        // Far outside of the image finite differences are too coarse.
        if (std::fabs(e.u) > 3000 || std::fabs(e.v) > 3000) continue;
        const Ellipse<double> d{0.3, -0.2, 500, 700, -300, 2, 5};
        const Gaussian3d<double> gradient =
            project_gaussian_vjp(g, kView, camera, kFilter, true, s, e, d);
        for (int k = 0; k < 11; ++k) {
            constexpr double kStep = 1e-6;
            Gaussian3d<double> before = g, after = g;
            (&before.mean[0])[k] -= kStep;
            (&after.mean[0])[k] += kStep;
            const double slope = (loss_of(after, camera) - loss_of(before, camera)) / (2 * kStep);
            const double got = (&gradient.mean[0])[k];
            // Near the axis of a fisheye a series is used, which is not exact.
            expect(std::fabs(got - slope) < 1e-4 * (30 + std::fabs(slope)), named, "gradient", got,
                   slope);
        }
    }
}

// ---- density

// The largest density of pixels in the image, by finite differences; that of a pinhole without the
// growth of slopes away from the axis.
void check_density(const Named& named) {
    const auto& camera = named.camera;
    const double bound = camera.px2_per_steradian();
    double most = 0;
    for (int round = 0; round < 20000; ++round) {
        double p[3], u, v;
        set_direction(3.0, p);
        if (!is_drawn(camera, p)) continue;
        const auto at = camera.linearized(camera.limits(), p);
        camera.to_pixel(at, p, u, v);
        if (u < 0 || v < 0 || u > camera.width || v > camera.height) continue;
        double across[3];
        cross3(at.j1, at.j2, across);
        double density = std::sqrt(dot3(across, across));
        if (camera.model() == LensModel::opencv) density *= p[2] * p[2] * p[2];
        most = std::fmax(most, density);
    }
    expect(most <= bound, named, "density, at most", most, bound);
    expect(bound <= 1.5 * most || named.camera.cx < 0, named, "density, not far above", bound,
           most);
}

// ---- culling

// The sides with the eye at the origin, and a box of half extents around a centre.
bool is_culled(const Intrinsics<double>& camera, const FrustumSides& sides, const double center[3],
               const double half[3]) {
    InstanceAxes in{{1, 0, 0, 0, 1, 0, 0, 0, 1}, {}, {}};
    Plane plane[5];
    Pinhole<double>::set_planes(sides, in, in, camera.front_offset(in, 1), plane);
    float direction[3];
    camera.set_guard_direction(in, direction);
    for (const Plane& p : plane) {
        double nearest = double(p.offset), guarded = 0;
        for (int k = 0; k < 3; ++k) {
            nearest += double(p.normal[k]) * center[k] - std::fabs(double(p.normal[k])) * half[k];
            guarded += std::fabs(double(direction[k])) * half[k];
        }
        if (nearest > double(p.guard) * guarded) return true;
    }
    return false;
}

struct Seen {
    int culled, drawn;
};

// No gaussian in a culled box reaches the window.
Seen check_culling(const Named& named, double first_distance, double last_distance,
                   double most_size, double pad_px) {
    struct Eye : Intrinsics<double>, ImagePart {};
    const Eye eye{named.camera, {40, 30, named.camera.width - 60, named.camera.height - 20}};
    const FrustumSides sides = Intrinsics<double>::sides_of(&eye, 1, pad_px);
    Seen seen{};
    for (int round = 0; round < 60000; ++round) {
        double center[3], half[3], mean[3], d[3];
        set_direction(kPi, center);
        const double distance =
            std::exp(uniform(std::log(first_distance), std::log(last_distance)));
        for (double& x : center) x *= distance;
        for (double& x : half) x = most_size * distance * uniform(0, 1) * uniform(0, 1);
        for (int k = 0; k < 3; ++k) {
            const double share = uniform(-1, 1);
            mean[k] = center[k] + share * half[k];
            d[k] = (1 - std::fabs(share)) * half[k] * (round % 2 ? 1 : -1) * (round % 3 ? 1 : -1);
        }
        const bool culled = is_culled(named.camera, sides, center, half);
        seen.culled += culled;
        if (!is_drawn(named.camera, mean)) continue;
        const auto at = eye.linearized(eye.limits(), mean);
        double u, v, a1, a2;
        eye.to_pixel(at, mean, u, v);
        eye.times_jacobian(at, d[0], d[1], d[2], a1, a2);
        // The segment from u - a to u + a against the padded window.
        double first = -1, last = 1;
        const double middle[2] = {u, v}, reach[2] = {a1, a2};
        const double low[2] = {eye.x0 - pad_px, eye.y0 - pad_px};
        const double high[2] = {eye.x1 + pad_px, eye.y1 + pad_px};
        for (int k = 0; k < 2; ++k) {
            const double one = (low[k] - middle[k]) / reach[k],
                         other = (high[k] - middle[k]) / reach[k];
            first = std::fmax(first, std::fmin(one, other));
            last = std::fmin(last, std::fmax(one, other));
        }
        const bool reaches = first <= last;
        seen.drawn += reaches;
        expect(!(reaches && culled), named, "a culled box reaches the window, at u", u, -1);
    }
    return seen;
}

}  // namespace

int main() {
    for (const Named& named : cameras()) {
        check_jacobian(named);
        named.camera.visit([&](const auto& model) { check_gradients(named, model); });
        check_gradients(named, named.camera);
        check_density(named);
        const Seen small = check_culling(named, 0.1, 10, 0.05, 2);
        check_culling(named, 0.1, 10, 1.5, 10);
        expect(small.drawn > 100, named, "gaussians that are drawn, at least", small.drawn, 100);
        // Planes enclose a fisheye of less than 172 degrees.
        const bool is_wide = named.camera.model() == LensModel::fisheye && named.camera.fx < 200;
        expect(is_wide || small.culled > 20000, named, "boxes that are culled, at least",
               small.culled, 20000);
    }
    return failures != 0;
}
