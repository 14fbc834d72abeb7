#pragma once

// Counters and scan states that the blocks of a cut's kernels share.

#include <algorithm>

#include "select/cut_parts.cuh"

namespace v3dg {
namespace cuda {

// Number of threads in a block of place_kernel. It is small, so that a few thousand
// instances occupy the whole device.
constexpr unsigned kPlaceThreads = 64;

// Device memory that all blocks share in one round of a cut. It must initially be zero,
// except for the two states of cut_kernel, which place_kernel clears.
struct CutScratch {
    unsigned *place_ticket, *cut_ticket;
    unsigned* num_parts;
    Count* place_state;               // one element per block of place_kernel
    Count *unit_state, *count_state;  // one element per ticket of cut_kernel
    unsigned num_places;              // number of blocks of cut_kernel that can run concurrently

    // Returns how many parts a block processes together. It is at most one per warp,
    // and less if there are not enough parts for all blocks. Warps without a part help
    // to test the block's other parts.
    __device__ unsigned parts_at_once(unsigned parts) const {
        return min(max(blocks_for(parts, num_places), 1u), kCutWarps);
    }
};

// Returns the number of blocks of place_kernel. It is at least one, because the kernel
// also writes the pictures.
inline unsigned place_blocks(size_t num_instances) {
    return std::max(1u, blocks_for(num_instances, kPlaceThreads));
}

// Returns the number of zeros in a CutScratch: two elements for three 32-bit counters,
// and the states of place_kernel's blocks.
inline size_t zeros_of_round(size_t num_instances) { return 2 + place_blocks(num_instances); }

// Divides memory into the arrays of a CutScratch. `states` must have two elements per
// ticket.
inline CutScratch scratch_in(Count* zeros, Count* states, size_t num_tickets, unsigned num_places) {
    auto* counters = reinterpret_cast<unsigned*>(zeros);
    return {.place_ticket = counters,
            .cut_ticket = counters + 1,
            .num_parts = counters + 2,
            .place_state = zeros + 2,
            .unit_state = states,
            .count_state = states + num_tickets,
            .num_places = num_places};
}

}  // namespace cuda
}  // namespace v3dg
