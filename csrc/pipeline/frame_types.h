#pragma once

// What the stages of a CUDA frame hand to each other, on the device. A frame is a batch of pictures: one for
// the screen, thousands for the targets of local splatting.

#include <cstdint>
#include <cstring>

#include "project/project.h"

namespace v3dg {
namespace cuda {

// A block blends one tile, a warp 8 x 4 of its pixels.
constexpr int kFrameTileWidth = 32, kFrameTileHeight = 16;
// Records that an item may make: as many as a block has threads.
constexpr int kItemSize = 256;

// Gaussians as rows, as users hold them (GaussianRows), on the device. Quaternions and SH coefficients start
// at a multiple of 16 bytes.
struct DeviceRows {
    const float *means, *quats, *scales, *opacities, *sh;  // (N, 3), (N, 4), (N, 3), (N,), (N, bases, 3)
    int sh_degree;
};

// The same packed: four planes of (N, 4) that hold a PackedGaussian each, and the SH coefficients.
struct PackedRows {
    const float* plane[4];
    const float* sh;
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

// What a budget came to: the tolerance that was used, or that the coarsest cut, of `least` gaussians, exceeds
// it and nothing was selected.
struct CutChoice {
    float tolerance_px2;
    bool exceeds_budget;
    unsigned long long least;
};

// Counted on the device. What exceeds a capacity is counted but not stored, and nothing is then drawn.
struct FrameCounters {
    unsigned long long items, gaussians, in_frustum, records, entries;
    unsigned long long slots;  // of gradients, in a frame that keeps a tape
    CutChoice choice;          // where there is a budget
};

// Neighbouring gaussians of a placed model, or of a model that several placements share: those at
// `placement` + k for each bit k of `sharers`, where it is not 0. They are to have one picture, and to make
// kItemSize records at most: there is room for those from `record` on, and they stand at its beginning, by
// gaussian and then by placement.
struct DrawItem {
    uint32_t placement, first, count, record;
    float filter_px2;
    uint32_t compensate;
    uint32_t sharers;
};

// Where the items of a frame are written, in their order. Counts what there is, stores what there is room
// for: counters->items, and in counters->gaussians the end of the last item's records. Items that would end
// past record_capacity need not be stored.
struct ItemList {
    DrawItem* items;
    FrameCounters* counters;
    unsigned long long item_capacity, record_capacity;
};

// A gaussian in the list of a tile, in one word: 26 bits of depth, the 28 bits of the record, and 10 of where
// in the tile it is. Lists are blended by ascending depth, ties by record; entries in one step of the key's
// depth by the depths of their records, unless a tile has more than a thousand of them.
struct TileEntry {
    unsigned long long key;
};
constexpr int kEntryRecordBits = 28, kEntryBoxBits = 10;
constexpr unsigned long long kMostFrameRecords = 1ull << kEntryRecordBits;
constexpr int kEntryBlockSize = 4;  // px; the box counts in blocks

// Depth as entries hold it; it is at least the camera's near depth. A step of the key is 5e-7 of the depth;
// the last one is 32 octaves behind near.
V3DG_HD inline uint32_t entry_depth(float depth, float near_depth) {
    uint32_t depth_bits, near_bits;  // of positive floats, so they order as they do
    std::memcpy(&depth_bits, &depth, sizeof depth_bits);
    std::memcpy(&near_bits, &near_depth, sizeof near_bits);
    return min_of((depth_bits - near_bits) >> 2, (1u << 26) - 1);
}

// First and last block, in the picture, that a record's pixels lie in.
struct EntryBox {
    int x0, x1, y0, y1;
};
V3DG_HD inline EntryBox entry_box(const Record<float>& r) {
    return {r.x0 / kEntryBlockSize, r.x1 / kEntryBlockSize, r.y0 / kEntryBlockSize, r.y1 / kEntryBlockSize};
}

// In the tile of this column and row of the picture, which the box meets.
V3DG_HD inline TileEntry tile_entry(uint32_t depth, uint32_t record, const EntryBox& box, int column,
                                    int row) {
    constexpr int kColumns = kFrameTileWidth / kEntryBlockSize, kRows = kFrameTileHeight / kEntryBlockSize;
    const uint32_t x0 = max_of(box.x0 - kColumns * column, 0), y0 = max_of(box.y0 - kRows * row, 0);
    const uint32_t x1 = min_of(box.x1 - kColumns * column, kColumns - 1);
    const uint32_t y1 = min_of(box.y1 - kRows * row, kRows - 1);
    const unsigned long long depth_and_record =
        static_cast<unsigned long long>(depth) << kEntryRecordBits | record;
    return {depth_and_record << kEntryBoxBits | (x0 | x1 << 3 | y0 << 6 | y1 << 8)};
}
V3DG_HD inline uint32_t record_of(TileEntry e) {
    return static_cast<uint32_t>(e.key >> kEntryBoxBits) & static_cast<uint32_t>(kMostFrameRecords - 1);
}
// A bit for each 4 x 4 pixels of the tile, row by row, that the record's box meets.
V3DG_HD inline uint32_t blocks_of(TileEntry e) {
    const uint32_t box = static_cast<uint32_t>(e.key);
    const uint32_t columns = (2u << (box >> 3 & 7)) - (1u << (box & 7));
    const uint32_t below = box >> 6 & 3, last = box >> 8 & 3;
    return columns * (0x01010101u >> (8 * (3 - last)) & 0x01010101u << (8 * below));
}

// A tile in the order in which tiles are blended, and how its list was spread if that is long.
struct TilePlan {
    uint32_t tile, image;
    uint32_t lowest;  // of the depths that the buckets were made for
    uint16_t last_bucket, shift;
};

// Input of the blend stage.
struct FrameLists {
    const FrameImage* images;
    const uint32_t* image_of_tile;  // [num_tiles]
    uint32_t num_tiles;
    const Record<float>* records;          // in the order of items and gaussians, with gaps between items
    const unsigned long long* tile_first;  // [num_tiles + 1] into entries
    TileEntry *entries, *scratch;          // each tile's in any order
    const FrameCounters* counters;
    unsigned long long record_capacity, entry_capacity;  // records: at most kMostFrameRecords
    TilePlan* plans;                                     // [num_tiles] scratch
};

}  // namespace cuda
}  // namespace v3dg
