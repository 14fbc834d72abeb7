#pragma once

// A gaussian, the memory layouts of many gaussians, and the reach of a gaussian. Its
// alpha at a pixel is in rasterize/rasterize_math.h.

#include <cstddef>
#include <cstdint>

#include "math/quat.h"
#include "math/sh.h"

namespace v3dg {

constexpr double kMinAlpha = 1.0 / 255;  // smaller alphas are not blended
constexpr double kMaxAlpha = 0.999;      // larger alphas are clamped to this value
// gsplat's stop rule: a pixel stops before its transmittance falls to this value.
constexpr double kMinTransmittance = 1e-4;
constexpr double kLog2MinAlpha = -7.994353436858858;
// The distance, in standard deviations, at which the alpha of an opaque gaussian is
// 1/255.
constexpr double kReachSigmas = 3.33;
constexpr double kLn2 = 0.6931471805599453;
// sqrt(log2(e) / 2). With this scale, exp(-d² / 2) = 2^-(scale d)².
constexpr double kFalloffScale = 0.8493218002880191;

template <class V>
struct Gaussian3d {
    V mean[3];
    V quat[4];   // w, x, y, z, of any nonzero length
    V scale[3];  // standard deviations
    V opacity;
};

// Gaussians in the layout of the Python interface, on the host or on a device: (N, 3),
// (N, 4), (N, 3), (N,) and (N, bases, 3). T is const if they are only read. On a
// device, quaternions and SH coefficients are aligned to 16 bytes.
template <class T>
struct GaussianRows {
    T *means, *quats, *scales, *opacities, *sh;
    size_t size;
    int sh_degree;

    V3DG_HD int num_sh() const { return 3 * num_sh_bases(sh_degree); }
    V3DG_HD operator GaussianRows<const T>() const {
        return {.means = means,
                .quats = quats,
                .scales = scales,
                .opacities = opacities,
                .sh = sh,
                .size = size,
                .sh_degree = sh_degree};
    }
};

// Returns the gaussian in row `row`, without SH coefficients.
template <class T>
V3DG_HD inline Gaussian3d<T> gaussian_in_row(const GaussianRows<const T>& rows, size_t row) {
    Gaussian3d<T> g;
    for (int k = 0; k < 3; ++k) g.mean[k] = rows.means[3 * row + k];
    for (int k = 0; k < 4; ++k) g.quat[k] = rows.quats[4 * row + k];
    for (int k = 0; k < 3; ++k) g.scale[k] = rows.scales[3 * row + k];
    g.opacity = rows.opacities[row];
    return g;
}

// Copies row `from` of `source` to row `to`, without SH coefficients.
template <class T>
V3DG_HD inline void copy_shape(const GaussianRows<const T>& source, size_t from,
                               const GaussianRows<T>& rows, size_t to) {
    for (size_t k = 0; k < 3; ++k) {
        rows.means[3 * to + k] = source.means[3 * from + k];
        rows.scales[3 * to + k] = source.scales[3 * from + k];
    }
    for (size_t k = 0; k < 4; ++k) rows.quats[4 * to + k] = source.quats[4 * from + k];
    rows.opacities[to] = source.opacities[from];
}

// Number of extra elements at the end of a plane. They allow a vector load to read
// beyond the last gaussian. The layout of the CPU rasterizer has one plane per
// component.
constexpr size_t kPlanePadding = 16;
template <class T>
struct GaussianPlanes {
    const T* mean[3];
    const T* quat[4];
    const T* scale[3];
    const T* opacity;
    const T* sh[3 * kMaxShBases];  // basis by basis, with three channels each
    int sh_degree;
};

// Colours of a bundle's clusters, which replace the colours of their gaussians.
struct Palette {
    const float* sh = nullptr;           // (C, 3) SH coefficients of degree 0, or null
                                         // if there is no palette
    const int64_t* first_row = nullptr;  // first gaussian of each cluster, ascending
    uint32_t num_clusters = 0;

    // Returns the cluster of a gaussian of the bundle.
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

// Gaussians in the layout of CUDA frames. Four planes of (N, 4) contain one
// PackedGaussian per row. SH coefficients are stored in rows, which begin `sh_stride`
// floats apart.
struct PackedPlanes {
    const float* plane[4];
    const float* sh;
    int sh_degree, sh_stride;
    Palette palette;
};

// Returns an upper bound on the reach of a gaussian, in standard deviations. It is at
// least the reach that extent_of() computes. It is negative if the gaussian is too
// faint to be drawn, and NaN if the opacity is invalid.
V3DG_HD inline float reach_in_sigmas(float opacity) {
    if (opacity < float(kMinAlpha)) return -1.0f;
    const float sigmas =
        sqrt_of(log2_of(opacity) - float(kLog2MinAlpha)) * float(1.001 / kFalloffScale);
    return opacity <= 1 ? sigmas : NAN;
}

// Returns an upper bound on how far a gaussian reaches from its mean, in model space.
// It may be NaN if a scale is not positive.
V3DG_HD inline float reach_of(const Gaussian3d<float>& g) {
    const float sigmas = reach_in_sigmas(g.opacity);
    if (sigmas < 0) return -1.0f;
    const float least = min_of(g.scale[0], min_of(g.scale[1], g.scale[2]));
    const float most = max_of(g.scale[0], max_of(g.scale[1], g.scale[2]));
    return least > 0 ? most * sigmas : NAN;
}

// A gaussian in the form that is fastest to project, for models that are drawn
// repeatedly. Its covariance is F Fᵀ with F = [f[0] f[3] 0; f[1] f[4] f[6]; f[2] f[5]
// f[7]]. The first column of F is the longest.
struct PackedGaussian {
    float mean[3];
    float reach;
    float f[8];
    float log2_opacity;
};

// Return a * b and a + b, without floating-point contraction under any compiler
// options.
V3DG_HD inline double product_of(double a, double b) {
#ifdef __CUDA_ARCH__
    return __dmul_rn(a, b);
#else
    return a * b;
#endif
}
V3DG_HD inline double sum_of(double a, double b) {
#ifdef __CUDA_ARCH__
    return __dadd_rn(a, b);
#else
    return a + b;
#endif
}

// Returns 1 / b for use in quotient_of().
V3DG_HD inline double inverse_of(double b) {
#ifdef __CUDA_ARCH__
    double r;
    asm("rcp.approx.ftz.f64 %0, %1;" : "=d"(r) : "d"(b));
    const double error = __fma_rn(-b, r, 1.0);
    r = __fma_rn(r, __fma_rn(error, error, error), r);
    return __fma_rn(r, __fma_rn(-b, r, 1.0), r);
#else
    return 1 / b;
#endif
}
// Returns a / b, where `inverse` is inverse_of(b). The result equals that of a division
// on a device. Precondition: the numbers are far from the limits of doubles, which is
// true for all numbers that are computed from float32.
V3DG_HD inline double quotient_of(double a, double b, double inverse) {
#ifdef __CUDA_ARCH__
    const double q = __dmul_rn(a, inverse);
    return __fma_rn(inverse, __fma_rn(-b, q, a), q);
#else
    (void)inverse;
    return a / b;
#endif
}
// Rounds to float32. Code that reads the result treats values below 2^-126 as 0.
V3DG_HD inline float rounded(double x) {
#ifdef __CUDA_ARCH__
    float y;
    asm("cvt.rn.f32.f64 %0, %1;" : "=f"(y) : "d"(x));
    return y;
#else
    return static_cast<float>(x);
#endif
}

// Packs a gaussian. Every rounding is explicit, so that all kernels compute the same
// bits.
V3DG_HD inline PackedGaussian pack_gaussian(const Gaussian3d<float>& g) {
    PackedGaussian out{};
    for (int k = 0; k < 3; ++k) out.mean[k] = g.mean[k];
    out.log2_opacity = log2_of(g.opacity);
    out.reach = reach_of(g);
    // The columns of the rotation matrix, as in rotation_of_quat().
    const double w = g.quat[0], x = g.quat[1], y = g.quat[2], z = g.quat[3];
    const double xx = product_of(x, x), yy = product_of(y, y), zz = product_of(z, z),
                 wx = product_of(w, x), wz = product_of(w, z), xz = product_of(x, z);
    const double n2 = sum_of(sum_of(::fma(w, w, xx), yy), zz),
                 s = n2 > 0 ? quotient_of(2, n2, inverse_of(n2)) : 0;
    double column[3][3] = {
        {::fma(sum_of(yy, zz), -s, 1.0), product_of(s, ::fma(x, y, wz)),
         product_of(s, ::fma(-w, y, xz))},
        {product_of(s, ::fma(x, y, -wz)), ::fma(sum_of(xx, zz), -s, 1.0),
         product_of(s, ::fma(y, z, wx))},
        {product_of(s, ::fma(w, y, xz)), product_of(s, ::fma(y, z, -wx)),
         ::fma(sum_of(xx, yy), -s, 1.0)},
    };
    // Sort by scale. Indices are compile-time constants, so that values stay in
    // registers.
    float scale[3] = {g.scale[0], g.scale[1], g.scale[2]};
    for (int pass = 0; pass < 3; ++pass) {
        const int k = pass % 2;
        const bool is_in_order = scale[k] >= scale[k + 1];
        const float longer = is_in_order ? scale[k] : scale[k + 1];
        scale[k + 1] = is_in_order ? scale[k + 1] : scale[k];
        scale[k] = longer;
        for (int i = 0; i < 3; ++i) {
            const double of_longer = is_in_order ? column[k][i] : column[k + 1][i];
            column[k + 1][i] = is_in_order ? column[k + 1][i] : column[k][i];
            column[k][i] = of_longer;
        }
    }
    for (int k = 0; k < 3; ++k)
        for (int i = 0; i < 3; ++i) column[k][i] = product_of(column[k][i], scale[k]);
    // Rotate columns 1 and 2 by a Givens rotation, so that column 2 begins with 0. The
    // rotation does not change F Fᵀ. Rotating the two shortest columns gives the
    // smallest rounding errors.
    const double a0 = column[1][0], b0 = column[2][0],
                 length = sqrt_of(::fma(a0, a0, product_of(b0, b0)));
    const double inverse = inverse_of(length);
    const double cosine = length > 0 ? quotient_of(a0, length, inverse) : 1,
                 sine = length > 0 ? quotient_of(b0, length, inverse) : 0;
    for (int i = 0; i < 3; ++i) {
        const double a = column[1][i], b = column[2][i];
        column[1][i] = ::fma(a, cosine, product_of(b, sine));
        column[2][i] = ::fma(b, cosine, -product_of(a, sine));
    }
    for (int i = 0; i < 3; ++i) {
        out.f[i] = rounded(column[0][i]);
        out.f[3 + i] = rounded(column[1][i]);
    }
    out.f[6] = rounded(column[2][1]);
    out.f[7] = rounded(column[2][2]);
    return out;
}

}  // namespace v3dg
