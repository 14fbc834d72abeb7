#pragma once

// The tiles that a record may touch, and the lists from which tiles are blended, on
// CUDA. Tiles are numbered consecutively over a batch of pictures, row by row.

#include <cstdint>
#include <cstring>

#include "frame/counters.h"
#include "frame/image.h"
#include "frame/record.h"

namespace v3dg {
namespace cuda {

// A gaussian in the list of a tile, packed into 64 bits: 54 bits for depth and record,
// and 10 for its box in the tile. A record has 26 bits and a depth 28, which is exact.
// In frames with room for more records, a record has up to two more bits and a depth up
// to two fewer. Lists are blended by ascending depth; ties are ordered by record. If
// depths are not exact, entries of equal depth are ordered by the depths of their
// records, unless more than a thousand entries of a tile share 26 bits.
struct TileEntry {
    unsigned long long key;
};
constexpr int kLeastRecordBits = 26, kMostRecordBits = 28, kEntryBoxBits = 10;
constexpr unsigned long long kMostFrameRecords = 1ull << kMostRecordBits;
constexpr int kEntryBlockSize = 4;  // px; boxes are in units of these blocks
// 32 octaves beyond the near depth; everything farther gets this value.
constexpr uint32_t kLastEntryDepth = (1u << 28) - 1;

constexpr uint32_t kExactDepths = ~0u << 4;

// Returns the mask of the depth bits in the upper half of an entry, in a frame with
// room for this many records.
inline uint32_t depth_mask_of_entries(unsigned long long most_records) {
    uint32_t mask = kExactDepths;
    for (auto held = 1ull << kLeastRecordBits; held < most_records; held *= 2) mask <<= 1;
    return mask;
}

// Returns the depth of an entry, in steps of a float's last bit, or of up to four of
// them if records need more bits. Precondition: the depth is at least the camera's near
// depth.
V3DG_HD inline uint32_t entry_depth(float depth, float near_depth, uint32_t depth_mask) {
    uint32_t depth_bits, near_bits;  // positive floats are ordered like their bits
    std::memcpy(&depth_bits, &depth, sizeof depth_bits);
    std::memcpy(&near_bits, &near_depth, sizeof near_bits);
    return min_of(depth_bits - near_bits, kLastEntryDepth) & depth_mask >> 4;
}

constexpr uint32_t kTileBlockColumns = kFrameTileWidth / kEntryBlockSize;
constexpr uint32_t kTileBlockRows = kFrameTileHeight / kEntryBlockSize;

// The first and last block that contain pixels of a record, relative to the corner of
// the picture or of a tile.
struct EntryBox {
    uint32_t x0, x1, y0, y1;
};

// Returns the blocks of a box of pixels in the picture.
template <class Box>
V3DG_HD inline EntryBox entry_box(const Box& pixels) {
    const auto block_of = [](auto pixel) { return static_cast<uint32_t>(pixel) / kEntryBlockSize; };
    return {block_of(pixels.x0), block_of(pixels.x1), block_of(pixels.y0), block_of(pixels.y1)};
}

// Returns an entry for the tile in this column and row, relative to the origin of the
// box. Precondition: the box meets the tile.
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

// Return the first 26 bits of the depth, and the 28 bits after them.
V3DG_HD inline uint32_t key_depth(TileEntry e) {
    return static_cast<uint32_t>(e.key >> (kEntryBoxBits + kMostRecordBits));
}
V3DG_HD inline uint32_t key_order(TileEntry e) {
    return static_cast<uint32_t>(e.key >> kEntryBoxBits) & ((1u << kMostRecordBits) - 1);
}

// Returns a mask of the 4 x 4 blocks of the tile that the record's box meets, row by
// row.
V3DG_HD inline uint32_t blocks_of(TileEntry e) {
    // The entry stores the first block, and how many columns and rows the box lacks to
    // the full size.
    static_assert(kTileBlockColumns == 8 && kTileBlockRows == 4, "a row of blocks is a byte");
    const uint32_t box = static_cast<uint32_t>(e.key), fewer = box >> 5;
    return (0xffu >> (fewer & 7)) * (0x01010101u >> (fewer & 24)) << (box & 31);
}

// A tile, or one of its parts, in blending order. The parts of a tile are contiguous;
// the first one describes how the tile's list was spread, if it is long.
struct TilePlan {
    uint32_t tile, image;  // kNoTile for an empty plan
    uint32_t lowest;       // lowest depth in the buckets
    uint16_t last_bucket, shift;
    uint8_t part, log2_parts;
    // The list is in windows, so that parts of the tile can be blended concurrently.
    bool in_windows;
    bool in_scratch;                   // The spread list is in scratch memory, not in place.
    unsigned long long first_scratch;  // index of the list in scratch memory, if it is there
};
constexpr uint32_t kNoTile = ~0u;
constexpr int kPlanClasses = 64;  // classes of plans, by load

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

// The records of a frame in three planes, in the order of a Record's fields.
struct RecordPlanes {
    float* ellipse;       // (N, 8) u, v, l11, l12, l22, log2_opacity, two channels
    float* rest;          // (N, 2) the third channel and the depth
    RecordBox* box;       // null unless the frame keeps a tape, because few records need it later
    uint32_t depth_mask;  // mask of the depth bits in the upper half of entries

    V3DG_HD uint32_t record_of(TileEntry e) const {
        return static_cast<uint32_t>(e.key >> kEntryBoxBits) &
               ~(depth_mask << (32 - kEntryBoxBits));
    }
    // Returns a value with the order of depths. is_exact() says whether equal values
    // mean equal depths.
    V3DG_HD uint32_t depth_of(TileEntry e) const {
        return static_cast<uint32_t>(e.key >> 32) & depth_mask;
    }
    V3DG_HD bool is_exact(TileEntry e) const {
        // The last value represents many depths.
        return depth_mask == kExactDepths && depth_of(e) != kExactDepths;
    }
};

// Input of the blend stage.
struct FrameLists {
    const FrameImage* images;
    const uint32_t* image_of_tile;  // [num_tiles]
    uint32_t num_tiles;
    RecordPlanes records;                  // ordered by item and gaussian, with gaps between items
    const unsigned long long* tile_first;  // [num_tiles + 1] indices into `entries`
    TileEntry *entries, *scratch;          // the entries of each tile, unordered
    FrameCounters* counters;
    Capacity capacity;  // at most kMostFrameRecords records
    TilePlan* plans;    // [num_plans] scratch memory
    // [2 * kPlanClasses] initially zero: the number of plans of each class, and the
    // number of those already written.
    uint32_t* plan_counts;
    // Plans claimed beyond the first of each block of spread_kernel; initially zero.
    unsigned* taken;
    uint32_t num_plans;  // num_tiles, or most_plans() if tiles may be in parts
    // Shared by all images; kStopsByCut for a cut by a budget, whose tolerance is in
    // the counters.
    float min_transmittance;
    // The destinations of images without one of their own: of the first and of the
    // second.
    PicturePlanes planes[2] = {};
    bool has_depth = true;  // must be true if any image has depth
    // Destination of a copy of the counters on the host; may be null.
    FrameCounters* report = nullptr;
};

// A record over more tiles than this is processed by rows of tiles.
constexpr unsigned kFewTiles = 4;

// The tiles that contain a record's blocks: the first one, and the number of columns
// and rows.
struct TileBox {
    uint32_t left, top, columns, count;

    // Return the distance of tile k, of at most kFewTiles, from the first. A box of
    // more than two columns has one row.
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

// A record over few tiles, packed for the scattering kernel: its depth, the index of
// its first tile in the picture, and its blocks relative to that tile: the first block,
// and the number of further ones.
using FewTiles = unsigned long long;
// The code of a box of five columns, which no such record has.
constexpr FewTiles kManyTiles = ~FewTiles(0);
constexpr int kFewBoxBits = 14, kFewTileBits = 22;
// Records whose first tile is later count as large.
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

// A record over more than kFewTiles tiles, or some of its rows of tiles with the pixels
// in these. Large records are stored in batches of kLargeAtOnce from one item, and
// therefore from neighbours in one picture; a batch is padded at its end. A batch
// covers at most kMostLargeTiles tiles, or one row of tiles of each record.
struct alignas(16) LargeRecord {
    uint32_t record, image;  // kNoRecord for padding
    RecordBox box;
};
constexpr unsigned kLargeAtOnce = 16;
constexpr int kMostLargeTiles = 1024;
constexpr uint32_t kNoRecord = ~0u;

// The records of an item, and the tiles of their picture.
struct ItemTiles {
    uint32_t num_records, record, first_tile, columns;
};

// The counts of records per tile by project(), and scratch memory of tile_bin(). All is
// zero before project().
struct TileCounts {
    uint32_t* count;  // [num_tiles] records over at most kFewTiles tiles; zero after tile_bin()
    // Claimed parts of the scan; claimed items whose records are scattered.
    unsigned *scan_ticket, *taken;
    unsigned long long* state;  // [tile_bin_parts(num_tiles)]
};

}  // namespace cuda
}  // namespace v3dg
