#pragma once

// What the stages of a CUDA frame hand to each other, on the device. A frame is a batch of pictures: one for
// the screen, thousands for the targets of local splatting.

#include <cstdint>

#include "project/project.h"

namespace v3dg {
namespace cuda {

// A block blends one tile, a warp 8 x 4 of its pixels.
constexpr int kFrameTileWidth = 32, kFrameTileHeight = 16;
// Gaussians that one block projects.
constexpr int kItemSize = 256;

// Gaussians as rows, as users hold them (GaussianRows), on the device.
struct DeviceRows {
    const float *means, *quats, *scales, *opacities, *sh;  // (N, 3), (N, 4), (N, 3), (N,), (N, bases, 3)
    int sh_degree;
};

// One picture of a batch.
struct FrameImage {
    Pinhole<float> camera;
    int width, height;
    int tile_columns, tile_rows;
    uint32_t first_tile;  // in the batch, its tiles row by row
    float background[3];
    float *color, *alpha, *depth;  // as Picture<float> has them; depth may be null
};

// A model in front of a picture's camera.
struct Placement {
    ModelView<float> view;
    uint32_t model, image;
};

// At most kItemSize neighbouring gaussians of a placed model.
struct DrawItem {
    uint32_t placement, first, count;
    float filter_px2;
    uint32_t compensate;
};

// Counted on the device. What exceeds a capacity is counted but not stored, and nothing is then drawn.
struct FrameCounters {
    unsigned long long items, gaussians, in_frustum, records, entries;
};

// A gaussian in the list of a tile. Lists are blended by ascending depth, ties by record.
struct TileEntry {
    uint32_t depth_bits;  // of a positive float, so they order as it does
    uint32_t record;
};

// Input of the blend stage.
struct FrameLists {
    const FrameImage* images;
    const uint32_t* image_of_tile;  // [num_tiles]
    uint32_t num_tiles;
    const Record<float>* records;  // in the order of items and gaussians, gaussians without a record left out
    const unsigned long long* tile_first;  // [num_tiles + 1] into entries
    TileEntry *entries, *scratch;          // each tile's in any order
    const FrameCounters* counters;
    unsigned long long record_capacity, entry_capacity;
};

}  // namespace cuda
}  // namespace v3dg
