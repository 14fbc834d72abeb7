// One cluster after another, on all threads.

#include "base/parallel_for.h"
#include "gather/gather_math.h"

namespace v3dg {

void cpu::gather(const GatherInput& in, const GaussianRows<float>& out) {
    parallel_for(in.instance.size, 16, [&](size_t s) {
        for (int64_t within = 0; within < in.offset[s + 1] - in.offset[s]; ++within) {
            gather_shape(in, s, within, out);
            for (int basis = 0; basis < num_sh_bases(out.sh_degree); ++basis)
                gather_sh(in, s, within, basis, out);
        }
    });
}

}  // namespace v3dg
