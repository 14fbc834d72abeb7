#pragma once

// Plans of tiles, and the spreading of long lists into bucket order.

#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// Plans the blending of each tile by `num_places` concurrent blocks, and spreads each
// list that is longer than a piece over buckets of depth, as its plan says.
void spread_lists(const FrameLists& lists, uint32_t num_places, cudaStream_t stream);

// Returns the largest number of plans with this many concurrent blocks, if tiles may be
// blended in parts.
uint32_t most_plans(uint32_t num_tiles, uint32_t num_places);

}  // namespace cuda
}  // namespace v3dg
