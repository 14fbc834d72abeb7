#include "draw/false_color.h"

#include <algorithm>
#include <cmath>

namespace v3dg {

namespace {

// The colours of levels, beginning with the finest. Adjacent levels differ in hue and
// in lightness.
constexpr Rgb kLevels[] = {{0.90f, 0.24f, 0.22f}, {0.98f, 0.60f, 0.17f}, {0.99f, 0.88f, 0.30f},
                           {0.50f, 0.78f, 0.32f}, {0.20f, 0.65f, 0.55f}, {0.26f, 0.65f, 0.90f},
                           {0.27f, 0.40f, 0.80f}, {0.55f, 0.35f, 0.75f}, {0.85f, 0.45f, 0.70f}};
constexpr size_t kHues = std::size(kLevels);
constexpr Rgb kRamp[kRampColors] = {
    {0.05f, 0.03f, 0.15f}, {0.27f, 0.06f, 0.39f}, {0.53f, 0.13f, 0.42f}, {0.77f, 0.23f, 0.33f},
    {0.94f, 0.42f, 0.20f}, {0.99f, 0.66f, 0.22f}, {0.99f, 0.95f, 0.65f}};
constexpr Rgb kThere{0.13f, 0.45f, 0.5f}, kNear{1.0f, 0.85f, 0.3f}, kFar{0.75f, 0.1f, 0.1f};
constexpr float kMostOctaves = 6;  // ratios above 2^6 all have the same colour

Rgb between(const Rgb& from, const Rgb& to, float share) {
    Rgb color{};
    for (size_t a = 0; a < 3; ++a) color[a] = from[a] + share * (to[a] - from[a]);
    return color;
}

}  // namespace

Rgb level_color(size_t level) {
    const size_t turn = level / kHues, place = level % kHues;
    Rgb color = kLevels[place];
    if (turn % 2 == 1) {
        color = between(color, kLevels[(place + kHues - 1) % kHues], 0.5f);
        for (float& part : color) part *= 0.6f;
    }
    const float strength = std::pow(0.6f, static_cast<float>(turn / 2));
    for (float& part : color) part = 1 - (1 - part) * strength;
    return color;
}

Rgb cluster_color(size_t cluster) {
    constexpr double kGolden = 0.6180339887498949;
    constexpr float kLightness[3] = {1.0f, 0.75f, 0.55f};
    Rgb color{};
    for (size_t a = 0; a < 3; ++a) {
        const double hue =
            std::fmod(static_cast<double>(cluster) * kGolden + static_cast<double>(a) / 3, 1.0);
        const double wave = std::clamp(std::abs(6 * hue - 3) - 1, 0.0, 1.0);
        color[a] = static_cast<float>(0.25 + 0.75 * wave) * kLightness[cluster % 3];
    }
    return color;
}

Rgb ramp_color(float value) {
    const float at = std::clamp(value, 0.0f, 1.0f) * (kRampColors - 1);
    const size_t first = std::min(static_cast<size_t>(at), kRampColors - 2);
    return between(kRamp[first], kRamp[first + 1], at - static_cast<float>(first));
}

Rgb missing_color(float share, float most) {
    if (!(share > most)) return kThere;
    return between(kNear, kFar, std::min(std::log2(share / most), kMostOctaves) / kMostOctaves);
}

}  // namespace v3dg
