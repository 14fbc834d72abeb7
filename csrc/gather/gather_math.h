#pragma once

// Formulas of gather(), for the CPU and CUDA, in double precision.

#include <vector>

#include "base/host_device.h"
#include "gather/gather.h"
#include "gather/sh_rotation.h"
#include "math/quat.h"

namespace v3dg {

// The rotations of all instances, and the matrices that rotate their SH bands.
struct Rotations {
    const double* rotation;  // [I * 9] row-major matrices
    const double* bands;     // [I * kBandsSize]; empty if the result has SH degree 0
};

// Owns the arrays of Rotations.
struct RotationTables {
    std::vector<double> rotation, bands;

    RotationTables(const GatherInput& in, int sh_degree);
};

// Writes a gaussian without its SH coefficients. `within` is the index of the gaussian
// in cluster s.
V3DG_HD inline void gather_shape(const GatherInput& in, const Rotations& rotations, size_t s,
                                 int64_t within, const GaussianRows<float>& out) {
    const int64_t from = in.first_row[s] + within, to = in.offset[s] + within;
    const size_t i = in.instance[s];
    const GaussianRows<const float>& rows = in.bundles[in.bundle[i]];
    const double *r = rotations.rotation + 9 * i, scale = in.scale[i];
    const double x = rows.means[3 * from], y = rows.means[3 * from + 1],
                 z = rows.means[3 * from + 2];
    for (int k = 0; k < 3; ++k) {
        const double rotated = r[3 * k] * x + r[3 * k + 1] * y + r[3 * k + 2] * z;
        out.means[3 * to + k] = static_cast<float>(scale * rotated + in.position[3 * i + k]);
        out.scales[3 * to + k] = static_cast<float>(scale * rows.scales[3 * from + k]);
    }
    double q[4];
    for (int k = 0; k < 4; ++k) q[k] = in.quaternion[4 * i + k];
    if (is_out_of_range(length2_of_quat(q))) bring_into_range(q);
    const float* p = rows.quats + 4 * from;
    double product[4] = {
        q[0] * p[0] - q[1] * p[1] - q[2] * p[2] - q[3] * p[3],
        q[0] * p[1] + q[1] * p[0] + q[2] * p[3] - q[3] * p[2],
        q[0] * p[2] - q[1] * p[3] + q[2] * p[0] + q[3] * p[1],
        q[0] * p[3] + q[1] * p[2] - q[2] * p[1] + q[3] * p[0],
    };
    round_quat(product, out.quats + 4 * to);
    float opacity = rows.opacities[from];
    if (in.weight.size != 0) opacity *= in.weight[s];
    if (in.factors.size != 0) opacity *= in.factors[i].opacity;
    out.opacities[to] = opacity;
}

// Writes the three coefficients of one SH basis of a gaussian, rotated into the world
// and multiplied by the tint.
V3DG_HD inline void gather_sh(const GatherInput& in, const Rotations& rotations, size_t s,
                              int64_t within, int basis, const GaussianRows<float>& out) {
    const int64_t from = in.first_row[s] + within, to = in.offset[s] + within;
    const size_t i = in.instance[s];
    const GaussianRows<const float>& rows = in.bundles[in.bundle[i]];
    const float* coefficients = rows.sh + rows.num_sh() * from;
    float* result = out.sh + out.num_sh() * to + 3 * basis;
    const auto write = [&](int c, double coefficient) {
        if (in.factors.size != 0)
            coefficient = tinted_coefficient(basis, coefficient, in.factors[i].color[c]);
        result[c] = static_cast<float>(coefficient);
    };
    if (basis == 0 || 3 * basis >= rows.num_sh()) {
        for (int c = 0; c < 3; ++c) write(c, basis == 0 ? coefficients[c] : 0.0f);
        return;
    }
    const int degree = basis < 4   ? 1
                       : basis < 9 ? 2
                                   : 3,
              first = degree * degree, size = 2 * degree + 1;
    const double* band = rotations.bands + kBandsSize * i +
                         (degree == 1   ? 0
                          : degree == 2 ? 9
                                        : 9 + 25);
    for (int c = 0; c < 3; ++c) {
        double sum = 0;
        for (int k = 0; k < size; ++k)
            sum += band[(basis - first) * size + k] * coefficients[3 * (first + k) + c];
        write(c, sum);
    }
}

}  // namespace v3dg
