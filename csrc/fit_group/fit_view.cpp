#include <algorithm>
#include <cmath>

#include "base/random.h"
#include "fit_group/fit_group.h"
#include "math/solid_angle.h"

namespace v3dg {

// The paper's code looks at a 64 px image with a focal length of 88.9 px.
constexpr double kFocalPerSize = 88.9 / 64;
// Room around the ball for what its gaussians draw beyond it.
constexpr double kMarginPx = 2.5;

static void multiply(const double a[9], const double b[9], double out[9]) {
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k)
            out[3 * i + k] = a[3 * i] * b[k] + a[3 * i + 1] * b[3 + k] + a[3 * i + 2] * b[6 + k];
}

// Uniform rotation from three uniform numbers (Shoemake 1992).
static void random_rotation(double u0, double u1, double u2, double r[9]) {
    const double a = std::sqrt(1 - u0), b = std::sqrt(u0), s = 2 * kPi * u1, t = 2 * kPi * u2;
    const double x = a * std::sin(s), y = a * std::cos(s), z = b * std::sin(t), w = b * std::cos(t);
    const double out[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                           2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                           2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    std::copy_n(out, 9, r);
}

FitView fit_view(const FitConfig& config, const FitGroup& group, uint64_t index) {
    const auto uniform = [&](uint64_t counter) { return random_uniform(config.seed, group.stream, counter); };
    double rotation[9];
    if (config.num_views > 0) {
        // A Fibonacci lattice of directions, each with a random roll, all turned together.
        double lattice[9], turn[9];
        const double z = 1 - (2.0 * index + 1) / config.num_views, r = std::sqrt(std::max(0.0, 1 - z * z));
        const double angle = index * kPi * (3 - std::sqrt(5.0)), roll = 2 * kPi * uniform(16 + 3 * index);
        const double forward[3] = {r * std::cos(angle), r * std::sin(angle), z};
        const double side[3] = {-std::sin(angle), std::cos(angle), 0};
        const double up[3] = {forward[1] * side[2] - forward[2] * side[1],
                              forward[2] * side[0] - forward[0] * side[2],
                              forward[0] * side[1] - forward[1] * side[0]};
        for (int k = 0; k < 3; ++k) {
            lattice[k] = std::cos(roll) * side[k] + std::sin(roll) * up[k];
            lattice[3 + k] = std::cos(roll) * up[k] - std::sin(roll) * side[k];
            lattice[6 + k] = forward[k];
        }
        random_rotation(uniform(0), uniform(1), uniform(2), turn);
        multiply(lattice, turn, rotation);
    } else {
        // Far from the numbers that shift the picture.
        const uint64_t base = (uint64_t(1) << 63) + 4 * index;
        random_rotation(uniform(base), uniform(base + 1), uniform(base + 2), rotation);
    }

    FitView view;
    for (int i = 0; i < 9; ++i) view.rotation[i] = static_cast<float>(rotation[i]);
    double focal, shift_x = 0, shift_y = 0;
    if (config.image_size > 0) {
        view.size = config.image_size;
        focal = kFocalPerSize * config.image_size;
    } else {
        // The focal length at which the ball's footprint (select_math.h) has the wanted number of px².
        const double x2 = 1 / (static_cast<double>(config.distance) * config.distance);
        focal =
            std::sqrt(static_cast<double>(group.count) * config.px2_per_gaussian / solid_angle_of_ball(x2));
        const double radius_px = focal * std::sqrt(x2 / (1 - x2));
        view.size = 4 * static_cast<int>(std::ceil((radius_px + kMarginPx) / 2));  // whole blocks of 4 px
        shift_x = uniform(16 + 3 * index + 1) - 0.5;
        shift_y = uniform(16 + 3 * index + 2) - 0.5;
    }
    view.focal = static_cast<float>(focal);
    view.cx = static_cast<float>(view.size / 2.0 + shift_x);
    view.cy = static_cast<float>(view.size / 2.0 + shift_y);
    return view;
}

}  // namespace v3dg
