// Each thread gathers one cluster at a time.

#include "base/parallel_for.h"
#include "gather/gather_math.h"
#include "math/quat.h"

namespace v3dg {

RotationTables::RotationTables(const GatherInput& in, int sh_degree)
    : rotation(9 * in.bundle.size), bands(sh_degree > 0 ? kBandsSize * in.bundle.size : 0) {
    parallel_for(in.bundle.size, 256, [&](size_t i) {
        rotation_of_quat(in.quaternion.data + 4 * i, rotation.data() + 9 * i);
        if (sh_degree > 0)
            rotate_sh_bands(rotation.data() + 9 * i, sh_degree, bands.data() + kBandsSize * i);
    });
}

void cpu::gather(const GatherInput& in, const GaussianRows<float>& out) {
    const RotationTables tables(in, out.sh_degree);
    const Rotations rotations{tables.rotation.data(), tables.bands.data()};
    parallel_for(in.instance.size, 16, [&](size_t s) {
        for (int64_t within = 0; within < in.offset[s + 1] - in.offset[s]; ++within) {
            gather_shape(in, rotations, s, within, out);
            for (int basis = 0; basis < num_sh_bases(out.sh_degree); ++basis)
                gather_sh(in, rotations, s, within, basis, out);
        }
    });
}

}  // namespace v3dg
