#pragma once

// Plans how tiles are blended, and spreads long lists over buckets of depth.

#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// Plans the blending of all tiles by `num_places` concurrent blocks. Spreads each list
// that is longer than a piece over buckets of depth, as its plan describes.
void spread_lists(const FrameLists& lists, uint32_t num_places, cudaStream_t stream);

// Returns the number of plans to allocate if `num_places` concurrent blocks may blend
// tiles in parts.
uint32_t most_plans(uint32_t num_tiles, uint32_t num_places);

}  // namespace cuda
}  // namespace v3dg
