// Encodes pages. Each thread processes one cluster at a time: first its ranges, then
// the codes of its gaussians.

#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include "base/parallel_for.h"
#include "quantize/coded_ranges.h"
#include "quantize/quantize.h"

namespace v3dg {

namespace {

constexpr size_t kClustersAtOnce = 16;
constexpr double kMostPosition = 0x1p126, kMostColorValue = 32768, kMostShValue = 1024;

// The 24 rotations that map a cube onto itself, as quaternions w, x, y, z of any
// length.
constexpr int8_t kCubeRotations[24][4] = {
    {1, 0, 0, 0},  {0, 1, 0, 0},   {0, 0, 1, 0},  {0, 0, 0, 1},   {1, 1, 1, 1},   {1, 1, 1, -1},
    {1, 1, -1, 1}, {1, 1, -1, -1}, {1, -1, 1, 1}, {1, -1, 1, -1}, {1, -1, -1, 1}, {1, -1, -1, -1},
    {1, 1, 0, 0},  {1, -1, 0, 0},  {1, 0, 1, 0},  {1, 0, -1, 0},  {1, 0, 0, 1},   {1, 0, 0, -1},
    {0, 1, 1, 0},  {0, 1, -1, 0},  {0, 1, 0, 1},  {0, 1, 0, -1},  {0, 0, 1, 1},   {0, 0, 1, -1},
};

// A gaussian in double precision. Its axes are permuted such that its rotation can be
// coded.
struct Prepared {
    double mean[3], quat[3], color[3];  // quat: x, y, z, in units of kQuatStep
    uint32_t scale_bits[3];             // bits of the float, relative to kLeastScaleBits
};

double clamped(double x, double least, double most) { return std::min(std::max(x, least), most); }

// Returns the distance from |x| to the next float32.
double float_spacing(double x) { return x == 0 ? 0 : std::ldexp(1, std::ilogb(x) - 23); }

uint32_t code_of(double value, double first, double step, uint32_t most) {
    return step > 0 ? static_cast<uint32_t>(clamped(std::rint((value - first) / step), 0, most))
                    : 0;
}

// Converts a number below 65,504 to a half. `round` is a function such as std::floor.
uint16_t half_of(double x, double (*round)(double)) {
    const int exponent = x == 0 ? -14 : std::max(std::ilogb(x), -14);
    const double fraction = round(std::ldexp(x, 10 - exponent));
    const uint32_t bits =
        (static_cast<uint32_t>(exponent + 14) << 10) + static_cast<uint32_t>(std::abs(fraction));
    return static_cast<uint16_t>((fraction < 0 ? 0x8000u : 0u) | std::min(bits, 0x7bffu));
}

// Converts a step to a half, in units of kStepUnit. A step below the smallest normal
// half becomes 0, because differences in a range that small are invisible.
uint16_t step_half(double step, double (*round)(double)) {
    return step < kStepUnit * 0x1p-14 ? uint16_t(0) : half_of(step / kStepUnit, round);
}

void check_is_finite(const GaussianRows<const float>& in, size_t row) {
    const int num_sh = in.num_sh();
    float sum = in.opacities[row] * 0;
    for (int k = 0; k < 3; ++k) sum += in.means[3 * row + k] * 0 + in.scales[3 * row + k] * 0;
    for (int k = 0; k < 4; ++k) sum += in.quats[4 * row + k] * 0;
    for (int k = 0; k < num_sh; ++k) sum += in.sh[num_sh * row + k] * 0;
    if (!(sum == 0))
        throw std::invalid_argument(
            "gaussians: expected finite values, got infinite or NaN ones in row " +
            std::to_string(row));
}

// Sets the scales, as bits of floats, and x, y, z of the quaternion. If the quaternion
// cannot be coded, the axes are permuted. They are not permuted if it can be coded, so
// that encoding a decoded gaussian gives the same codes.
void prepare_shape(const float* quat, const float* scale, Prepared& out) {
    double length2 = 0, q[4] = {1, 0, 0, 0};
    for (int k = 0; k < 4; ++k) length2 += double(quat[k]) * quat[k];
    if (length2 > 0)
        for (int k = 0; k < 4; ++k) q[k] = quat[k] / std::sqrt(length2);
    const double most_coded = (kZeroQuat + 0.5) / std::sqrt(double(kQuatLength2));
    const auto has_codes = [&](const double* p) {
        return std::max({std::abs(p[1]), std::abs(p[2]), std::abs(p[3])}) < most_coded;
    };
    double best[4] = {q[0], q[1], q[2], q[3]};
    int axis[3] = {0, 1, 2};
    for (size_t n = 1; n < 24 && !has_codes(q); ++n) {
        double p[4], r[9];
        for (int k = 0; k < 4; ++k) p[k] = kCubeRotations[n][k];
        const double length = std::sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2] + p[3] * p[3]);
        for (double& x : p) x /= length;
        const double w = q[0] * p[0] - q[1] * p[1] - q[2] * p[2] - q[3] * p[3];
        if (std::abs(w) <= std::abs(best[0])) continue;
        best[0] = w;
        best[1] = q[0] * p[1] + q[1] * p[0] + q[2] * p[3] - q[3] * p[2];
        best[2] = q[0] * p[2] - q[1] * p[3] + q[2] * p[0] + q[3] * p[1];
        best[3] = q[0] * p[3] + q[1] * p[2] - q[2] * p[1] + q[3] * p[0];
        rotation_of_quat(p, r);
        for (int j = 0; j < 3; ++j)
            for (int i = 0; i < 3; ++i)
                if (std::abs(r[3 * i + j]) > 0.5) axis[j] = i;
    }
    const double largest = std::max({scale[0], scale[1], scale[2]});
    for (int k = 0; k < 3; ++k) {
        out.quat[k] = std::copysign(1, best[0]) * best[k + 1] * std::sqrt(double(kQuatLength2));
        const double s = scale[axis[k]] > 0 ? scale[axis[k]] : largest * 0x1p-14;
        const float clamped_scale =
            static_cast<float>(clamped(s, 0x1p-64, float_of_bits(kMostScaleBits)));
        uint32_t bits;
        std::memcpy(&bits, &clamped_scale, sizeof bits);
        out.scale_bits[k] = bits - kLeastScaleBits;
    }
}

Prepared prepare(const GaussianRows<const float>& in, size_t row) {
    Prepared out;
    for (int k = 0; k < 3; ++k) {
        out.mean[k] = clamped(in.means[3 * row + k], -kMostPosition, kMostPosition);
        out.color[k] = clamped(in.sh[in.num_sh() * row + k], -kMostColorValue, kMostColorValue);
    }
    prepare_shape(in.quats + 4 * row, in.scales + 3 * row, out);
    return out;
}

struct Range {
    double first = kInfinite<double>, last = -kInfinite<double>;

    void add(double x) {
        first = std::min(first, x);
        last = std::max(last, x);
    }
    double magnitude() const { return std::max(std::abs(first), std::abs(last)); }
};

// Returns the step of a range of float32 numbers that are coded as first + code * step,
// with code <= most. It exceeds the exact step by at most the rounding error of the
// last number. Therefore decoded gaussians give the same step.
double step_of(const Range& range, double first, uint32_t most) {
    return (range.last - first + float_spacing(range.magnitude()) / 2) / most;
}

// Returns the ranges of a cluster, rounded inwards to values that a ClusterCode can
// store. Therefore the first and the last code of each range occur.
ClusterCode ranges_of(const std::vector<Prepared>& cluster) {
    Range mean[3], color[3];
    uint32_t least = ~0u, most = 0;
    for (const Prepared& g : cluster)
        for (int k = 0; k < 3; ++k) {
            mean[k].add(g.mean[k]);
            color[k].add(g.color[k]);
            least = std::min(least, g.scale_bits[k]);
            most = std::max(most, g.scale_bits[k]);
        }
    ClusterCode out{};
    for (int k = 0; k < 3; ++k) {
        out.mean_first[k] = static_cast<float>(mean[k].first);
        const double finest = 2 * float_spacing(mean[k].magnitude());
        double step = std::max(step_of(mean[k], mean[k].first, kMostMean), finest);
        if (step > 0) {  // 0 means that all values are equal
            const int exponent = std::ilogb(step);
            step = std::ldexp(std::floor(std::ldexp(step, 11 - exponent)), exponent - 11);
        }
        // A step below 2^-100 becomes 0, because its products might not be normal
        // numbers.
        const bool is_point = code_of(mean[k].last, mean[k].first, step, 1) == 0 || step < 0x1p-100;
        out.mean_step[k] = is_point ? 0 : static_cast<float>(step);

        out.color_first[k] = half_of(color[k].first, std::ceil);
        const double first = float_of_half(out.color_first[k]);
        const bool is_one = color[k].last - first < 1024 * float_spacing(color[k].magnitude());
        out.color_step[k] =
            step_half(is_one ? 0 : step_of(color[k], first, kMostColor), std::floor);
    }
    const uint32_t first =
        std::min((least + (1u << kScaleFirstShift) - 1) >> kScaleFirstShift, 0xffffu);
    out.scale_first = static_cast<uint16_t>(first);
    const uint32_t base = first << kScaleFirstShift;
    out.scale_step =
        static_cast<uint16_t>(most > base ? ((most - base) / kMostScale) >> kScaleStepShift : 0);
    return out;
}

void encode(const Prepared& g, float opacity, const ClusterRanges& ranges, uint32_t* record) {
    uint32_t mean[3], scale[3], color[3], quat[3];
    for (int k = 0; k < 3; ++k) {
        mean[k] = code_of(g.mean[k], ranges.mean_first[k], ranges.mean_step[k], kMostMean);
        color[k] = code_of(g.color[k], ranges.color_first[k], ranges.color_step[k], kMostColor);
        const double first = double(ranges.scale_first) - kLeastScaleBits;
        scale[k] = code_of(g.scale_bits[k], first, ranges.scale_step, kMostScale);
        quat[k] =
            static_cast<uint32_t>(kZeroQuat + clamped(std::rint(g.quat[k]), -kZeroQuat, kZeroQuat));
    }
    const uint32_t alpha = code_of(opacity, 0, 1.0 / kMostOpacity, kMostOpacity);
    record[0] = mean[0] | mean[1] << 12 | alpha << 24;
    record[1] = mean[2] | scale[0] << 12 | scale[1] << 22;
    record[2] = scale[2] | quat[0] << 10 | quat[1] << 19 | color[0] << 28;
    record[3] = color[0] >> 4 | color[1] << 5 | color[2] << 14 | quat[2] << 23;
}

// Converts a coefficient from red, green, blue to three channels: brightness, orange
// and green.
void channels_of(const float* rgb, double out[3]) {
    const double r = rgb[0], g = rgb[1], b = rgb[2];
    out[0] = clamped((r + 2 * g + b) / 4, -kMostShValue, kMostShValue);
    out[1] = clamped((r - b) / 2, -kMostShValue, kMostShValue);
    out[2] = clamped((2 * g - r - b) / 4, -kMostShValue, kMostShValue);
}

int most_sh_code(int sh_degree, int basis, int channel) {
    return (1 << (sh_bits(sh_degree, basis, channel) - 1)) - 1;
}

// Computes the step of each band and channel as a half. It is the largest value divided
// by the square of the largest code. A channel with values below 2^-11 of the
// brightness is dropped: such values are less than the smallest step of the brightness,
// and would be lost when converting to red, green and blue in float32.
void sh_steps_of(const GaussianRows<const float>& in, uint16_t* steps) {
    const int num_bases = num_sh_bases(in.sh_degree);
    double most[9] = {};
    for (size_t row = 0; row < in.size; ++row)
        for (int basis = 1; basis < num_bases; ++basis) {
            double value[3];
            channels_of(in.sh + in.num_sh() * row + 3 * basis, value);
            for (int c = 0; c < 3; ++c) {
                double& largest = most[3 * (band_of(basis) - 1) + c];
                largest = std::max(largest, std::abs(value[c]));
            }
        }
    for (int k = 0; k < 3 * in.sh_degree; ++k) {
        const double of_band = *std::max_element(most + k / 3 * 3, most + k / 3 * 3 + 3);
        const int code = most_sh_code(in.sh_degree, k < 3 ? 1 : k < 6 ? 4 : 9, k % 3);
        steps[k] = step_half(most[k] < of_band * 0x1p-11 ? 0 : most[k] / (code * code), std::rint);
    }
}

void encode_sh(const float* sh, const float* step, int sh_degree, uint32_t* words) {
    uint64_t bits = 0;  // bits that do not fill a word yet
    int num_bits = 0;
    for (int basis = 1; basis < num_sh_bases(sh_degree); ++basis) {
        double value[3];
        channels_of(sh + 3 * basis, value);
        for (int c = 0; c < 3; ++c) {
            const double unit = step[3 * (band_of(basis) - 1) + c];
            const int most = most_sh_code(sh_degree, basis, c);
            const double square = unit > 0 ? std::abs(value[c]) / unit : 0,
                         low = std::floor(std::sqrt(square));
            const double nearest = square > low * low + low + 0.5 ? low + 1 : low;
            const int code =
                static_cast<int>(std::copysign(std::min(nearest, double(most)), value[c]));
            bits |= static_cast<uint64_t>(most + code) << num_bits;
            num_bits += sh_bits(sh_degree, basis, c);
            if (num_bits < 32) continue;
            *words++ = static_cast<uint32_t>(bits);
            bits >>= 32;
            num_bits -= 32;
        }
    }
    if (num_bits > 0) *words = static_cast<uint32_t>(bits);
}

void encode_cluster(const GaussianRows<const float>& in, const PageCodes<uint32_t>& page,
                    size_t c) {
    std::vector<Prepared> cluster;
    cluster.reserve(in.size);
    for (size_t row = 0; row < in.size; ++row) cluster.push_back(prepare(in, row));
    CodedRanges coded;
    coded.code = ranges_of(cluster);
    sh_steps_of(in, coded.sh_steps);
    std::memcpy(page.ranges(c), &coded.code, sizeof coded.code);
    std::memcpy(page.ranges(c) + sizeof coded.code / 4, coded.sh_steps,
                6 * static_cast<size_t>(in.sh_degree));
    const ClusterRanges ranges = decoded(coded, in.sh_degree);
    const auto first = static_cast<size_t>(page.offset[c]);
    for (size_t row = 0; row < in.size; ++row) {
        encode(cluster[row], in.opacities[row], ranges, page.record(first + row));
        encode_sh(in.sh + in.num_sh() * row, ranges.sh_step, in.sh_degree, page.sh(first + row));
    }
}

}  // namespace

void cpu::encode_page(const GaussianRows<const float>& in, const PageCodes<uint32_t>& page) {
    std::fill_n(
        page.words,
        page_bytes(page.end_row() - page.first_row(), page.num_clusters(), page.sh_degree) / 4, 0u);
    parallel_for(page.num_clusters(), kClustersAtOnce, [&](size_t c) {
        const auto first = static_cast<size_t>(page.offset[c]),
                   last = static_cast<size_t>(page.offset[c + 1]);
        for (size_t row = first; row < last; ++row) check_is_finite(in, row);
        if (first == last) return;
        const GaussianRows<const float> rows{.means = in.means + 3 * first,
                                             .quats = in.quats + 4 * first,
                                             .scales = in.scales + 3 * first,
                                             .opacities = in.opacities + first,
                                             .sh = in.sh + in.num_sh() * first,
                                             .size = last - first,
                                             .sh_degree = in.sh_degree};
        encode_cluster(rows, page, c);
    });
}

}  // namespace v3dg
