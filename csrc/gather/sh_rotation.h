#pragma once

namespace v3dg {

// Doubles that the rotations of the SH bands 1, 2 and 3 take: matrices of 3, 5 and 7 rows, one
// after another.
constexpr int kBandsSize = 3 * 3 + 5 * 5 + 7 * 7;

// Matrices that take the coefficients of bands 1 to `degree` into the frame that a rotation (rows)
// leads to; those of higher bands are left alone. On the host, in double precision.
void rotate_sh_bands(const double rotation[9], int degree, double bands[kBandsSize]);

}  // namespace v3dg
