#pragma once

// Tile lists on CUDA: the entries of a list, and the records and plans that blending
// reads. Tiles are numbered consecutively over the pictures of a batch, row by row.

#include <cstdint>
#include <cstring>

#include "frame/counters.h"
#include "frame/image.h"
#include "frame/record.h"

namespace v3dg {
namespace cuda {

// A record in the list of a tile, packed into 64 bits: 28 bits for the depth, 26 for
// the index of the record, and 10 for its box in the tile. Lists are blended in
// ascending order of depth. Entries of equal depth are ordered by index.
//
// Frames with more records use up to two bits of the depth for the index. Depths are
// then rounded, and entries with equal rounded depth are ordered by the exact depths of
// their records. This order is not exact in tiles in which more than a thousand entries
// share 26 bits of depth.
struct TileEntry {
    unsigned long long key;
};
constexpr int kLeastRecordBits = 26, kMostRecordBits = 28, kEntryBoxBits = 10;
constexpr unsigned long long kMostFrameRecords = 1ull << kMostRecordBits;
constexpr int kEntryBlockSize = 4;  // px; boxes are in units of blocks of this size
// The largest depth of an entry, 32 octaves beyond the near depth. Larger depths are
// stored as this value.
constexpr uint32_t kLastEntryDepth = (1u << 28) - 1;

constexpr uint32_t kExactDepths = ~0u << 4;

// Returns the mask of the depth bits in the upper 32 bits of an entry, for a frame with
// at most `most_records` records.
inline uint32_t depth_mask_of_entries(unsigned long long most_records) {
    uint32_t mask = kExactDepths;
    for (auto held = 1ull << kLeastRecordBits; held < most_records; held *= 2) mask <<= 1;
    return mask;
}

// Converts a depth to the integer in an entry. It is the number of float steps beyond
// the near depth, without the bits that `depth_mask` drops. Precondition: the depth is
// at least the near depth.
V3DG_HD inline uint32_t entry_depth(float depth, float near_depth, uint32_t depth_mask) {
    // Bits of positive floats have the same order as the floats.
    uint32_t depth_bits, near_bits;
    std::memcpy(&depth_bits, &depth, sizeof depth_bits);
    std::memcpy(&near_bits, &near_depth, sizeof near_bits);
    return min_of(depth_bits - near_bits, kLastEntryDepth) & depth_mask >> 4;
}

constexpr uint32_t kTileBlockColumns = kFrameTileWidth / kEntryBlockSize;
constexpr uint32_t kTileBlockRows = kFrameTileHeight / kEntryBlockSize;

// The first and last column and row of blocks that a record touches, relative to the
// picture or to a tile.
struct EntryBox {
    uint32_t x0, x1, y0, y1;
};

// Converts a box of pixels to blocks.
template <class Box>
V3DG_HD inline EntryBox entry_box(const Box& pixels) {
    const auto block_of = [](auto pixel) { return static_cast<uint32_t>(pixel) / kEntryBlockSize; };
    return {block_of(pixels.x0), block_of(pixels.x1), block_of(pixels.y0), block_of(pixels.y1)};
}

// Returns a record's entry for the tile at (column, row). `box` and the tile are
// relative to the same origin. Precondition: the box touches the tile.
V3DG_HD inline TileEntry tile_entry(uint32_t depth, uint32_t record, const EntryBox& box,
                                    uint32_t column, uint32_t row) {
    const int left = static_cast<int>(kTileBlockColumns * column);
    const int top = static_cast<int>(kTileBlockRows * row);
    const uint32_t x0 = max_of(static_cast<int>(box.x0) - left, 0);
    const uint32_t y0 = max_of(static_cast<int>(box.y0) - top, 0);
    const uint32_t x1 = min_of(box.x1 - left, kTileBlockColumns - 1);
    const uint32_t y1 = min_of(box.y1 - top, kTileBlockRows - 1);
    const unsigned long long depth_and_record =
        static_cast<unsigned long long>(depth) << kLeastRecordBits | record;
    return {depth_and_record << kEntryBoxBits |
            ((3 - (y1 - y0)) << 8 | (7 - (x1 - x0)) << 5 | y0 << 3 | x0)};
}

// Divide a key into two parts. The first function returns the upper 26 bits of the
// depth. The second returns the next 28 bits: the other bits of the depth, then the
// index of the record.
V3DG_HD inline uint32_t key_depth(TileEntry e) {
    return static_cast<uint32_t>(e.key >> (kEntryBoxBits + kMostRecordBits));
}
V3DG_HD inline uint32_t key_order(TileEntry e) {
    return static_cast<uint32_t>(e.key >> kEntryBoxBits) & ((1u << kMostRecordBits) - 1);
}

// Returns a mask of the tile's blocks that the record's box touches: one bit per block
// of 4 x 4 px, row by row.
V3DG_HD inline uint32_t blocks_of(TileEntry e) {
    // The entry stores the first block, and how many columns and rows are missing to
    // fill the tile.
    static_assert(kTileBlockColumns == 8 && kTileBlockRows == 4,
                  "each row of blocks must fill one byte of the mask");
    const uint32_t box = static_cast<uint32_t>(e.key), fewer = box >> 5;
    return (0xffu >> (fewer & 7)) * (0x01010101u >> (fewer & 24)) << (box & 31);
}

// A tile, or a part of a tile, in the order of blending. The parts of a tile are
// adjacent. If the tile's list is long, the first part describes how the list was
// spread.
struct TilePlan {
    uint32_t tile, image;  // `tile` is kNoTile for an empty plan
    uint32_t lowest;       // smallest depth in the buckets
    uint16_t last_bucket, shift;
    uint8_t part, log2_parts;
    // Whether the list is divided into windows, so that the tile's parts can be blended
    // concurrently.
    bool in_windows;
    bool in_scratch;  // whether the spread list is in scratch memory
    // If in_scratch, the index of the list in scratch memory.
    unsigned long long first_scratch;
};
constexpr uint32_t kNoTile = ~0u;
// Number of classes into which plans are sorted by load.
constexpr int kPlanClasses = 64;

// The pixel box of a Record.
struct RecordBox {
    uint16_t x0, x1, y0, y1;
};
V3DG_HD inline uint32_t tile_columns_of(const RecordBox& r) {
    return r.x1 / kFrameTileWidth - r.x0 / kFrameTileWidth + 1u;
}
V3DG_HD inline uint32_t tile_rows_of(const RecordBox& r) {
    return r.y1 / kFrameTileHeight - r.y0 / kFrameTileHeight + 1u;
}
V3DG_HD inline uint32_t num_tiles_of(const RecordBox& r) {
    return tile_columns_of(r) * tile_rows_of(r);
}

// The records of a frame in three arrays, in the order of the fields of a Record.
struct RecordPlanes {
    float* ellipse;       // (N, 8) u, v, l11, l12, l22, log2_opacity, red, green
    float* rest;          // (N, 2) blue, depth
    RecordBox* box;       // null without a tape, because only the backward pass needs
                          // all boxes
    uint32_t depth_mask;  // the depth bits in the upper 32 bits of an entry's key

    V3DG_HD uint32_t record_of(TileEntry e) const {
        return static_cast<uint32_t>(e.key >> kEntryBoxBits) &
               ~(depth_mask << (32 - kEntryBoxBits));
    }
    // Returns an integer that has the same order as the depth. If is_exact(), equal
    // integers mean equal depths.
    V3DG_HD uint32_t depth_of(TileEntry e) const {
        return static_cast<uint32_t>(e.key >> 32) & depth_mask;
    }
    V3DG_HD bool is_exact(TileEntry e) const {
        // The largest value is shared by many depths.
        return depth_mask == kExactDepths && depth_of(e) != kExactDepths;
    }
};

// The input of the blend stage.
struct FrameLists {
    const FrameImage* images;
    const uint32_t* image_of_tile;  // [num_tiles] index of the image of each tile
    uint32_t num_tiles;
    RecordPlanes records;  // ordered by item, then by gaussian, with gaps between items
    const unsigned long long* tile_first;  // [num_tiles + 1] first entry of each tile
    // Each tile's entries in any order, and scratch memory.
    TileEntry *entries, *scratch;
    FrameCounters* counters;
    Capacity capacity;  // `records` is at most kMostFrameRecords
    TilePlan* plans;    // [num_plans] scratch memory
    // [2 * kPlanClasses] number of plans of each class, then number of written plans of
    // each class. Must initially be zero.
    uint32_t* plan_counts;
    // Work counter: number of plans that blocks of spread_kernel claimed in addition to
    // their first one. Must initially be zero.
    unsigned* taken;
    uint32_t num_plans;  // num_tiles, or most_plans() if tiles may be blended in parts
    // Used for all images. It is kStopsByCut for a cut with a budget, whose tolerance
    // is in the counters.
    float min_transmittance;
    // The destinations of the first and the second image, used if FrameImage has none.
    PicturePlanes planes[2] = {};
    bool has_depth = true;  // must be true if any image has a depth plane
    // Host memory for a copy of the counters; may be null.
    FrameCounters* report = nullptr;
    // The number of images that are filled with NaN if the counters exceed a capacity.
    // All of these images must have planes. If it is 0, images are not changed.
    uint32_t num_marked = 0;
};

// Records that touch more tiles than this are called large. They are processed by rows
// of tiles.
constexpr unsigned kFewTiles = 4;

// The tiles that a record touches: the first tile, the number of columns, and the
// number of tiles.
struct TileBox {
    uint32_t left, top, columns, count;

    // Return the offset of tile k from the first tile. Precondition: there are at most
    // kFewTiles tiles. A box with more than two columns then has only one row.
    V3DG_HD uint32_t columns_to(uint32_t k) const {
        return columns > 2 ? k : columns == 2 ? k & 1 : 0;
    }
    V3DG_HD uint32_t rows_to(uint32_t k) const {
        return columns > 2 ? 0 : columns == 2 ? k >> 1 : k;
    }
};

V3DG_HD inline TileBox tile_box(const EntryBox& b) {
    const uint32_t left = b.x0 / kTileBlockColumns, top = b.y0 / kTileBlockRows;
    const uint32_t columns = b.x1 / kTileBlockColumns - left + 1,
                   rows = b.y1 / kTileBlockRows - top + 1;
    return {left, top, columns, columns * rows};
}

// A record that touches few tiles, packed for the scatter kernel. It has the depth, the
// first tile in the picture, the first block relative to that tile, and the numbers of
// additional block columns and rows.
using FewTiles = unsigned long long;
// Marks a large record. No small record has this value, because its box would cover 5 x
// 5 tiles.
constexpr FewTiles kManyTiles = ~FewTiles(0);
constexpr int kFewBoxBits = 14, kFewTileBits = 22;
// The largest index of a tile that FewTiles can hold. If a record's first tile has a
// larger index, the record is treated as large.
constexpr uint32_t kMostFewTile = (1u << kFewTileBits) - 1;

V3DG_HD inline FewTiles few_tiles(uint32_t depth, uint32_t tile, const EntryBox& b) {
    const uint32_t box = b.x0 % kTileBlockColumns << 11 | b.y0 % kTileBlockRows << 9 |
                         (b.x1 - b.x0) << 4 | (b.y1 - b.y0);
    return FewTiles(depth) << (kFewBoxBits + kFewTileBits) | FewTiles(tile) << kFewBoxBits | box;
}
V3DG_HD inline uint32_t depth_of(FewTiles f) {
    return static_cast<uint32_t>(f >> (kFewBoxBits + kFewTileBits));
}
V3DG_HD inline uint32_t tile_of(FewTiles f) {
    return static_cast<uint32_t>(f >> kFewBoxBits) & kMostFewTile;
}
V3DG_HD inline EntryBox box_of(FewTiles f) {
    const uint32_t box = static_cast<uint32_t>(f), x0 = box >> 11 & 7, y0 = box >> 9 & 3;
    return {x0, x0 + (box >> 4 & 31), y0, y0 + (box & 15)};
}

// A large record, which touches more than kFewTiles tiles, or some rows of tiles of
// such a record. Large records are stored in batches of kLargeAtOnce. The records of a
// batch come from one item, and the end of a batch may be padding. A batch covers at
// most kMostLargeTiles tiles, or one row of tiles of each record.
struct alignas(16) LargeRecord {
    uint32_t record, image;  // `record` is kNoRecord for padding
    RecordBox box;
};
constexpr unsigned kLargeAtOnce = 16;
constexpr int kMostLargeTiles = 1024;
constexpr uint32_t kNoRecord = ~0u;

// The records of an item, and the tiles of its picture.
struct ItemTiles {
    uint32_t num_records, record, first_tile, columns;
};

// Counts of records per tile, which project() writes, and scratch memory of tile_bin().
// All of this memory must be zero before project().
struct TileCounts {
    // [num_tiles] counts of records that touch few tiles; tile_bin() resets them to
    // zero
    uint32_t* count;
    // Work counters: parts of the scan that were claimed, and items that the scatter
    // kernel claimed.
    unsigned *scan_ticket, *taken;
    unsigned long long* state;  // [tile_bin_parts(num_tiles)] state of the scan
};

}  // namespace cuda
}  // namespace v3dg
