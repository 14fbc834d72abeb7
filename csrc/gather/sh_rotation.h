#pragma once

// Rotations of spherical harmonics.

namespace v3dg {

// The number of doubles in the rotations of SH bands 1, 2 and 3: matrices of size 3, 5
// and 7, one after another.
constexpr int kBandsSize = 3 * 3 + 5 * 5 + 7 * 7;

// Computes matrices that transform the coefficients of bands 1 to `degree` into a
// rotated frame; those of higher bands are not written. `rotation` is row-major. Runs
// on the host, in double precision.
void rotate_sh_bands(const double rotation[9], int degree, double bands[kBandsSize]);

}  // namespace v3dg
