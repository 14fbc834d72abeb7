#pragma once

// Gaussians as rows, the way users hold them.

namespace v3dg {

// `num_sh` is 3 times the number of SH bases.
struct RowsIn {
    const float *means, *quats, *scales, *opacities, *sh;
    int num_sh;
};
struct RowsOut {
    float *means, *quats, *scales, *opacities, *sh;
};

}  // namespace v3dg
