#pragma once

// Writes the clusters that a block draws to the output list of a cut.

#include "base/scan.cuh"
#include "select/draw_items.cuh"

namespace v3dg {
namespace cuda {

// Appends the clusters that the threads of a block draw to a list, ordered by ticket,
// then by thread. All threads of the block must call it.
template <class Output>
__device__ void write_clusters(const LaneClusters& mine, unsigned ticket, bool is_last,
                               Count* unit_state, Count* count_state, const Output& output) {
    __shared__ Count before_units, before_gaussians;
    const WriteCount count = output.count(mine);
    // Both counts are summed in one 64-bit integer. An item has up to 256 gaussians; as
    // long as 36 bits hold the gaussians, 28 bits hold the units. Gaussians are in the
    // upper bits, so an overflow does not change the units.
    constexpr unsigned kUnitBits = 28, kUnits = (1u << kUnitBits) - 1;
    Count in_block;
    const Count before_in_block =
        block_prefix(Count{count.gaussians} << kUnitBits | count.units, in_block);
    const Count num_units = in_block & kUnits, num_gaussians = in_block >> kUnitBits;
    if (threadIdx.x < 64) {  // one warp for each of the two counts
        const bool is_units = threadIdx.x < 32;
        const Count before = prefix_of_part(is_units ? unit_state : count_state, ticket,
                                            is_units ? num_units : num_gaussians);
        if (threadIdx.x % 32 == 0) (is_units ? before_units : before_gaussians) = before;
    }
    __syncthreads();
    output.write(mine, before_units + (before_in_block & kUnits),
                 before_gaussians + (before_in_block >> kUnitBits));
    if (is_last && threadIdx.x == 0)
        output.finish(before_units + num_units, before_gaussians + num_gaussians);
}

}  // namespace cuda
}  // namespace v3dg
