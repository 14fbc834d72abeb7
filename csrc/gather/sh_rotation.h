#pragma once

// The rotation of spherical harmonics.

namespace v3dg {

// Number of doubles per rotation: square matrices of size 3, 5 and 7 for the SH bands
// 1, 2 and 3.
constexpr int kBandsSize = 3 * 3 + 5 * 5 + 7 * 7;

// Computes the matrices that transform the SH coefficients of bands 1 to `degree` into
// a rotated frame. Higher bands are not written. `rotation` is row-major. Runs on the
// host, in double precision.
void rotate_sh_bands(const double rotation[9], int degree, double bands[kBandsSize]);

}  // namespace v3dg
