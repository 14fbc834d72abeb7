#pragma once

// Formulas of pruning and merging, for the CPU and CUDA. They are compiled without
// floating-point contraction, and only use functions whose results are exactly rounded.
// Therefore the CPU and CUDA compute the same bits.

#include <cmath>
#include <cstdint>

#include "base/host_device.h"
#include "math/quat.h"
#include "math/sh.h"
#include "simplify/simplify.h"

namespace v3dg {

// Returns the importance of a gaussian for pruning, as the cube of opacity * (s1 s2
// s3)^(2/3) (V3DG, section 3.2: product of scale and opacity). The cube gives the same
// order, but needs no roots, whose last bits differ between libraries. Squared volumes
// of float32 scales do not overflow float64. A gaussian whose volume underflows is too
// small to be visible.
V3DG_HD inline double prune_score(const float scale[3], float opacity) {
    const double volume = static_cast<double>(scale[0]) * scale[1] * scale[2];
    const double o = opacity;
    return o * o * o * (volume * volume);
}

// Pruning keeps the same fraction of each octant of a group, so that no part of the
// group becomes empty. The octants meet at the median of each axis, as in the published
// code of V3DG. Octants work visibly better for elongated groups than repeated halving
// of the longest axis.
constexpr int kOctants = 8;

// Returns the octant of a position around the medians of its group. A coordinate that
// equals the median is in the upper half.
V3DG_HD inline int octant_of(const float mean[3], const float median[3]) {
    return 4 * (mean[0] >= median[0]) + 2 * (mean[1] >= median[1]) + (mean[2] >= median[2]);
}

// Returns the rank of the median of `count` values. If there are two middle values, it
// is the rank of the lower one.
V3DG_HD inline int64_t median_rank(int64_t count) { return (count - 1) / 2; }

// Returns how many gaussians of an octant are kept, if a group of `count` keeps
// `wanted`. The octant has `num_here` gaussians, and the octants before it have
// `num_before`. The results of all octants add up to `wanted`.
V3DG_HD inline int64_t octant_share(int64_t num_before, int64_t num_here, int64_t count,
                                    int64_t wanted) {
    return (num_before + num_here) * wanted / count - num_before * wanted / count;
}

// Returns the surface area of an ellipsoid divided by 4 pi, with an error of at most
// 1.2 %. The area of the ellipsoid's shadow, sqrt(b²c² x² + a²c² y² + a²b² z²), is
// averaged over the directions along the axes and along their diagonals. The weights
// minimise the largest error over all shapes. Only square roots are used, because every
// library rounds them exactly.
V3DG_HD inline double ellipsoid_area(double a, double b, double c) {
    constexpr double kAlongOne = 0.0604247, kBetweenTwo = 0.1013528, kBetweenThree = 0.5029995;
    const double bc = b * c, ac = a * c, ab = a * b;
    const double bc2 = bc * bc, ac2 = ac * ac, ab2 = ab * ab;
    return kAlongOne * (bc + ac + ab) +
           kBetweenTwo * (sqrt((bc2 + ac2) / 2) + sqrt((bc2 + ab2) / 2) + sqrt((ac2 + ab2) / 2)) +
           kBetweenThree * sqrt((bc2 + ac2 + ab2) / 3);
}

// Computes the covariance R diag(s²) Rᵀ: its upper triangle xx, xy, xz, yy, yz, zz.
V3DG_HD inline void covariance_of(const double quat[4], const double scale[3], double cov[6]) {
    double r[9];
    rotation_of_quat(quat, r);
    int entry = 0;
    for (int i = 0; i < 3; ++i)
        for (int k = i; k < 3; ++k) {
            cov[entry] = 0;
            for (int j = 0; j < 3; ++j)
                cov[entry] += r[3 * i + j] * r[3 * k + j] * scale[j] * scale[j];
            ++entry;
        }
}

// Computes the scales of a covariance and its axes, by cyclic Jacobi rotations. The
// axes are the columns of `e`, in the order of the scales.
V3DG_HD inline void scale_and_axes_of(const double cov[6], double scale[3], double e[3][3]) {
    double a[3][3] = {{cov[0], cov[1], cov[2]}, {cov[1], cov[3], cov[4]}, {cov[2], cov[4], cov[5]}};
    for (int i = 0; i < 3; ++i)
        for (int k = 0; k < 3; ++k) e[i][k] = i == k;
    for (int sweep = 0; sweep < 12; ++sweep) {
        const double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
        const double on = a[0][0] * a[0][0] + a[1][1] * a[1][1] + a[2][2] * a[2][2];
        if (off <= 1e-28 * on) break;
        for (int p = 0; p < 2; ++p)
            for (int q = p + 1; q < 3; ++q) {
                if (a[p][q] == 0) continue;
                const double theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
                const double t = (theta >= 0 ? 1 : -1) / (fabs(theta) + sqrt(theta * theta + 1));
                const double c = 1 / sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < 3; ++k) {
                    const double x = a[k][p], y = a[k][q];
                    a[k][p] = c * x - s * y;
                    a[k][q] = s * x + c * y;
                }
                for (int k = 0; k < 3; ++k) {
                    const double x = a[p][k], y = a[q][k];
                    a[p][k] = c * x - s * y;
                    a[q][k] = s * x + c * y;
                }
                for (int k = 0; k < 3; ++k) {
                    const double x = e[k][p], y = e[k][q];
                    e[k][p] = c * x - s * y;
                    e[k][q] = s * x + c * y;
                }
            }
    }
    for (int k = 0; k < 3; ++k) scale[k] = sqrt(a[k][k] > 0 ? a[k][k] : 0);
    const double det = e[0][0] * (e[1][1] * e[2][2] - e[1][2] * e[2][1]) -
                       e[0][1] * (e[1][0] * e[2][2] - e[1][2] * e[2][0]) +
                       e[0][2] * (e[1][0] * e[2][1] - e[1][1] * e[2][0]);
    if (det < 0)
        for (int k = 0; k < 3; ++k) e[k][2] = -e[k][2];
}

// Computes the quaternion of a rotation matrix.
V3DG_HD inline void quat_of_axes(const double e[3][3], double quat[4]) {
    // Begin with the component of largest magnitude, so that the code never divides by
    // a small number.
    const double four[4] = {1 + e[0][0] + e[1][1] + e[2][2], 1 + e[0][0] - e[1][1] - e[2][2],
                            1 - e[0][0] + e[1][1] - e[2][2], 1 - e[0][0] - e[1][1] + e[2][2]};
    int largest = 0;
    for (int k = 1; k < 4; ++k)
        if (four[k] > four[largest]) largest = k;
    const double h = sqrt(four[largest]) / 2, f = 1 / (4 * h);
    const double yz = (e[2][1] - e[1][2]) * f, zx = (e[0][2] - e[2][0]) * f,
                 xy = (e[1][0] - e[0][1]) * f;
    const double sxy = (e[0][1] + e[1][0]) * f, sxz = (e[0][2] + e[2][0]) * f,
                 syz = (e[1][2] + e[2][1]) * f;
    const double by_largest[4][4] = {
        {h, yz, zx, xy}, {yz, h, sxy, sxz}, {zx, sxy, h, syz}, {xy, sxz, syz, h}};
    for (int k = 0; k < 4; ++k) quat[k] = by_largest[largest][k];
}

// The properties of a gaussian that merging compares. `weight` is area * opacity.
struct MergeFeature {
    double mean[3], color[3], weight;
};

// A gaussian, or several joined gaussians, during merging.
struct MergeNode {
    MergeFeature feature;
    double cov[6], opacity;
};

V3DG_HD inline MergeNode merge_node_of(const GaussianRows<const float>& in, int64_t row) {
    MergeNode node;
    double scale[3], quat[4];
    for (int k = 0; k < 3; ++k) {
        node.feature.mean[k] = in.means[3 * row + k];
        node.feature.color[k] = kShBase0 * in.sh[in.num_sh() * row + k];
        scale[k] = in.scales[3 * row + k];
    }
    for (int k = 0; k < 4; ++k) quat[k] = in.quats[4 * row + k];
    covariance_of(quat, scale, node.cov);
    node.opacity = in.opacities[row];
    const double weight = ellipsoid_area(scale[0], scale[1], scale[2]) * node.opacity;
    node.feature.weight = weight > 1e-300 ? weight : 1e-300;
    return node;
}

// Returns the cost of joining a pair. It is the increase of the variance of colours and
// of positions, the latter relative to the spacing of the remaining gaussians. This is
// Ward's criterion, weighted by area * opacity.
V3DG_HD inline double merge_cost(const MergeFeature& a, const MergeFeature& b,
                                 double inverse_spacing2) {
    constexpr double kColorWeight = 6;
    double place = 0, color = 0;
    for (int k = 0; k < 3; ++k) {
        place += (a.mean[k] - b.mean[k]) * (a.mean[k] - b.mean[k]);
        color += (a.color[k] - b.color[k]) * (a.color[k] - b.color[k]);
    }
    return a.weight * b.weight / (a.weight + b.weight) *
           (place * inverse_spacing2 + kColorWeight * color);
}

// Returns `wanted` divided by the squared diagonal of the box of the means. It
// normalises squared distances.
V3DG_HD inline double inverse_spacing2_of(const double low[3], const double high[3],
                                          int64_t wanted) {
    double extent2 = 0;
    for (int k = 0; k < 3; ++k) extent2 += (high[k] - low[k]) * (high[k] - low[k]);
    return extent2 > 0 ? static_cast<double>(wanted) / extent2 : 0;
}

// Two gaussians, a before b, and the cost of joining them. Pairs are ordered by cost,
// then by index.
struct MergePair {
    double cost;
    int a, b;
};
V3DG_HD inline bool is_before(const MergePair& x, const MergePair& y) {
    return x.cost != y.cost ? x.cost < y.cost : (x.a != y.a ? x.a < y.a : x.b < y.b);
}

// Returns how many pairs one round joins, if there are `count` gaussians. It is half of
// the joins that remain, so that costs are updated in between.
V3DG_HD inline int64_t pairs_in_round(int64_t count, int64_t wanted) {
    return (count - wanted + 1) / 2;
}

// Joins `b` into `a`.
V3DG_HD inline void join(MergeNode& a, const MergeNode& b) {
    MergeFeature& f = a.feature;
    const double weight = f.weight + b.feature.weight, share = b.feature.weight / weight;
    double d[3];
    for (int k = 0; k < 3; ++k) d[k] = b.feature.mean[k] - f.mean[k];
    int entry = 0;
    for (int i = 0; i < 3; ++i)
        for (int k = i; k < 3; ++k) {
            a.cov[entry] +=
                share * (b.cov[entry] - a.cov[entry]) + share * (1 - share) * d[i] * d[k];
            ++entry;
        }
    for (int k = 0; k < 3; ++k) {
        f.mean[k] += share * d[k];
        f.color[k] += share * (b.feature.color[k] - f.color[k]);
    }
    f.weight = weight;
    double scale[3], axes[3][3];
    scale_and_axes_of(a.cov, scale, axes);
    const double opacity = weight / ellipsoid_area(scale[0], scale[1], scale[2]);
    a.opacity = opacity < 1 ? opacity : 1;
}

// Writes the position, shape and opacity of a joined gaussian.
V3DG_HD inline void write_joined(const MergeNode& node, const GaussianRows<float>& out,
                                 int64_t to) {
    double scale[3], axes[3][3], quat[4];
    scale_and_axes_of(node.cov, scale, axes);
    quat_of_axes(axes, quat);
    for (int k = 0; k < 3; ++k) {
        out.means[3 * to + k] = static_cast<float>(node.feature.mean[k]);
        out.scales[3 * to + k] = static_cast<float>(scale[k]);
    }
    for (int k = 0; k < 4; ++k) out.quats[4 * to + k] = static_cast<float>(quat[k]);
    out.opacities[to] = static_cast<float>(node.opacity);
}

}  // namespace v3dg
