#pragma once

// A gaussian, the layouts in which many of them are held, and how far one reaches.

#include <cstddef>
#include <cstdint>

#include "math/quat.h"
#include "math/sh.h"

namespace v3dg {

constexpr double kMinAlpha = 1.0 / 255;     // contributions below it are skipped
constexpr double kMaxAlpha = 0.999;         // alpha is cut here
constexpr double kMinTransmittance = 1e-4;  // a pixel that stops as gsplat's do stops before this
constexpr double kLog2MinAlpha = -7.994353436858858;
constexpr double kReachSigmas = 3.33;  // where opacity 1 has fallen below 1/255
constexpr double kLn2 = 0.6931471805599453;
constexpr double kFalloffScale = 0.8493218002880191;  // sqrt(log2(e) / 2): exp(-d²/2) = 2^-(scale d)²

template <class V>
struct Gaussian3d {
    V mean[3];
    V quat[4];   // w, x, y, z; any length but zero
    V scale[3];  // standard deviations
    V opacity;
};

// Gaussians as rows, the way users hold them, on the host or on a device: (N, 3), (N, 4), (N, 3), (N,) and
// (N, bases, 3). T is const where they are only read. On a device, quaternions and SH coefficients start at a
// multiple of 16 bytes.
template <class T>
struct GaussianRows {
    T *means, *quats, *scales, *opacities, *sh;
    size_t size;
    int sh_degree;

    V3DG_HD int num_sh() const { return 3 * num_sh_bases(sh_degree); }
    V3DG_HD operator GaussianRows<const T>() const {
        return {means, quats, scales, opacities, sh, size, sh_degree};
    }
};

// The same as the CPU's rasterizer reads them: a plane an attribute. Planes hold `kPlanePadding` elements
// more than there are gaussians, so that a vector load may run past the last.
constexpr size_t kPlanePadding = 16;
template <class T>
struct GaussianPlanes {
    const T* mean[3];
    const T* quat[4];
    const T* scale[3];
    const T* opacity;
    const T* sh[3 * kMaxShBases];  // base by base, three channels each
    int sh_degree;
};

// Colours of a bundle's clusters that gaussians are drawn in, in place of their own.
struct Palette {
    const float* sh = nullptr;           // (C, 3) coefficients of the constant basis; null: no palette
    const int64_t* first_row = nullptr;  // [C] where clusters begin among the gaussians, ascending
    uint32_t num_clusters = 0;

    // The cluster that a gaussian of the bundle belongs to.
    V3DG_HD uint32_t cluster_of(uint64_t row) const {
        uint32_t first = 0, last = num_clusters - 1;
        while (first < last) {
            const uint32_t middle = first + (last - first + 1) / 2;
            if (static_cast<uint64_t>(first_row[middle]) <= row)
                first = middle;
            else
                last = middle - 1;
        }
        return first;
    }
};

// The same as a CUDA frame reads what stays on the device: four planes of (N, 4) that hold a PackedGaussian
// each, and the SH coefficients as rows.
struct PackedPlanes {
    const float* plane[4];
    const float* sh;
    int sh_degree;
    Palette palette;
};

// How far from its mean a gaussian reaches at most, in its model's units: no less than extent_of() leads to.
// Negative where it is too faint to be drawn, not a number where it may have no area, or is none.
V3DG_HD inline float reach_of(const Gaussian3d<float>& g) {
    if (g.opacity < float(kMinAlpha)) return -1.0f;
    const float least = min_of(g.scale[0], min_of(g.scale[1], g.scale[2]));
    const float most = max_of(g.scale[0], max_of(g.scale[1], g.scale[2]));
    const float sigmas = sqrt_of(log2_of(g.opacity) - float(kLog2MinAlpha)) * float(1.001 / kFalloffScale);
    return least > 0 && g.opacity <= 1 ? most * sigmas : NAN;
}

// A gaussian in the form that is quickest to project, for what is projected more than once. Its covariance is
// F Fᵀ with F = [f[0] f[3] 0; f[1] f[4] f[6]; f[2] f[5] f[7]], columns from the longest on.
struct PackedGaussian {
    float mean[3];
    float reach;
    float f[8];
    float log2_opacity;
};

V3DG_HD inline PackedGaussian pack_gaussian(const Gaussian3d<float>& g) {
    PackedGaussian out{};
    for (int k = 0; k < 3; ++k) out.mean[k] = g.mean[k];
    out.log2_opacity = log2_of(g.opacity);
    out.reach = reach_of(g);
    double quat[4], r[9];
    for (int k = 0; k < 4; ++k) quat[k] = g.quat[k];
    rotation_of_quat(quat, r);
    int order[3] = {0, 1, 2};
    for (int pass = 0; pass < 3; ++pass) {
        const int k = pass % 2;
        if (g.scale[order[k]] >= g.scale[order[k + 1]]) continue;
        const int other = order[k];
        order[k] = order[k + 1];
        order[k + 1] = other;
    }
    double column[3][3];
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < 3; ++i) column[k][i] = r[3 * i + order[k]] * double(g.scale[order[k]]);
    // Rotate columns 1 and 2 by a Givens rotation so that column 2 begins with 0; F Fᵀ does not change. They
    // are the shortest columns, so their rounding is least.
    const double x = column[1][0], y = column[2][0], length = sqrt_of(x * x + y * y);
    const double cosine = length > 0 ? x / length : 1, sine = length > 0 ? y / length : 0;
    for (int i = 0; i < 3; ++i) {
        const double a = column[1][i], b = column[2][i];
        column[1][i] = cosine * a + sine * b;
        column[2][i] = cosine * b - sine * a;
    }
    for (int i = 0; i < 3; ++i) {
        out.f[i] = static_cast<float>(column[0][i]);
        out.f[3 + i] = static_cast<float>(column[1][i]);
    }
    out.f[6] = static_cast<float>(column[2][1]);
    out.f[7] = static_cast<float>(column[2][2]);
    return out;
}

}  // namespace v3dg
