#pragma once

// Rotations of spherical harmonics.

namespace v3dg {

// The number of doubles of the rotations of the SH bands 1, 2 and 3: matrices of 3, 5 and 7 rows,
// one after another.
constexpr int kBandsSize = 3 * 3 + 5 * 5 + 7 * 7;

// Computes matrices that transform the coefficients of bands 1 to `degree` into a rotated frame;
// those of higher bands are left alone. `rotation` is by rows. It runs on the host, in double
// precision.
void rotate_sh_bands(const double rotation[9], int degree, double bands[kBandsSize]);

}  // namespace v3dg
