// Each thread computes one box at a time.

#include "cluster/box.h"

#include "base/parallel_for.h"
#include "cluster/box_math.h"

namespace v3dg {

void cpu::bound_by_boxes(const BoxInput& in, Span<Box> box) {
    assert(in.offset.size == box.size + 1);
    parallel_for(box.size, 16, [&](size_t c) {
        box[c] = no_box();
        for (int64_t i = in.offset[c]; i < in.offset[c + 1]; ++i)
            grow(box[c], box_of_gaussian(in.means + 3 * i, in.quats + 4 * i, in.scales + 3 * i));
    });
}

}  // namespace v3dg
