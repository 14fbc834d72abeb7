#pragma once

#include <cmath>
#include <cstdint>

#include "base/host_device.h"
#include "math/quat.h"

namespace v3dg {

// Importance by which pruning decides: the cube of opacity * (s1 s2 s3)^(2/3) (V3DG, section 3.2: product of
// scale and opacity), which orders gaussians as that does and needs no roots, whose last bits differ from
// library to library. Squares of volumes of float32 scales do not overflow float64; what vanishes is smaller
// than anything that is seen.
V3DG_HD inline double prune_score(const float scale[3], float opacity) {
    const double volume = static_cast<double>(scale[0]) * scale[1] * scale[2];
    const double o = opacity;
    return o * o * o * (volume * volume);
}

// Pruning keeps the same share of each of these cells of a median split.
constexpr int kPruneHalvings = 3, kPruneCells = 1 << kPruneHalvings;

// How many of a cell's gaussians are kept when `wanted` of first .. last are: rounded so that they add up.
struct CellShares {
    int64_t first, last, wanted;
    V3DG_HD int64_t of(int64_t cell_first, int64_t cell_last) const {
        if (cell_first == cell_last) return 0;
        const int64_t count = last - first;
        return (cell_last - first) * wanted / count - (cell_first - first) * wanted / count;
    }
};

// Surface area of an ellipsoid over 4 pi (Thomsen's formula, within 1.1 %).
V3DG_HD inline double ellipsoid_area(double a, double b, double c) {
    constexpr double p = 1.6075;
    const double ap = pow(a, p), bp = pow(b, p), cp = pow(c, p);
    return pow((ap * bp + ap * cp + bp * cp) / 3, 1 / p);
}

// Upper triangle xx xy xz yy yz zz of R diag(s²) Rᵀ.
V3DG_HD inline void covariance_of(const double quat[4], const double scale[3], double cov[6]) {
    double r[9];
    rotation_of_quat(quat, r);
    int at = 0;
    for (int i = 0; i < 3; ++i)
        for (int k = i; k < 3; ++k) {
            cov[at] = 0;
            for (int j = 0; j < 3; ++j) cov[at] += r[3 * i + j] * r[3 * k + j] * scale[j] * scale[j];
            ++at;
        }
}

// Scales and quaternion of a covariance: cyclic Jacobi rotations, then the quaternion of the eigenvectors.
V3DG_HD inline void scale_and_quat_of(const double cov[6], double scale[3], double quat[4]) {
    double a[3][3] = {{cov[0], cov[1], cov[2]}, {cov[1], cov[3], cov[4]}, {cov[2], cov[4], cov[5]}};
    double e[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
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
    // The largest of the four components first, so that nothing small is divided by.
    const double four[4] = {1 + e[0][0] + e[1][1] + e[2][2], 1 + e[0][0] - e[1][1] - e[2][2],
                            1 - e[0][0] + e[1][1] - e[2][2], 1 - e[0][0] - e[1][1] + e[2][2]};
    int largest = 0;
    for (int k = 1; k < 4; ++k)
        if (four[k] > four[largest]) largest = k;
    const double h = sqrt(four[largest]) / 2, f = 1 / (4 * h);
    const double yz = (e[2][1] - e[1][2]) * f, zx = (e[0][2] - e[2][0]) * f, xy = (e[1][0] - e[0][1]) * f;
    const double sxy = (e[0][1] + e[1][0]) * f, sxz = (e[0][2] + e[2][0]) * f, syz = (e[1][2] + e[2][1]) * f;
    const double by_largest[4][4] = {
        {h, yz, zx, xy}, {yz, h, sxy, sxz}, {zx, sxy, h, syz}, {xy, sxz, syz, h}};
    for (int k = 0; k < 4; ++k) quat[k] = by_largest[largest][k];
}

}  // namespace v3dg
