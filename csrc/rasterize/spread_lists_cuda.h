#pragma once

#include "frame/tile_list.h"

namespace v3dg {
namespace cuda {

// Plans the blending of each tile, by `num_places` blocks at a time, and spreads each list that is
// longer than a piece over buckets of depth, as its plan tells.
void spread_lists(const FrameLists& lists, uint32_t num_places, cudaStream_t stream);

// Plans that so many places lead to at most where tiles may be blended in parts.
uint32_t most_plans(uint32_t num_tiles, uint32_t num_places);

}  // namespace cuda
}  // namespace v3dg
