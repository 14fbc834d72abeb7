#pragma once

// An entry of a tile's list on the CPU, packed into one integer. CUDA's entries are in
// tile_list.h.

#include <cstdint>
#include <cstring>

#include "frame/image.h"

namespace v3dg {

constexpr int kBlockSize = 4;  // px
constexpr int kTileBlocks = kTileSize / kBlockSize;

// Tables from the columns, or the rows, of a box in a tile to the blocks of the tile.
// An index has the first column in its lower 3 bits and the last one in the upper 3.
// The result is a mask with a bit per block, row by row.
struct BlocksOfBox {
    uint64_t columns[64] = {}, rows[64] = {};
    constexpr BlocksOfBox() {
        for (int first = 0; first < kTileBlocks; ++first)
            for (int last = first; last < kTileBlocks; ++last)
                for (int b = 0; b < kTileBlocks * kTileBlocks; ++b) {
                    const int column = b % kTileBlocks, row = b / kTileBlocks,
                              at = last << 3 | first;
                    if (first <= column && column <= last) columns[at] |= uint64_t(1) << b;
                    if (first <= row && row <= last) rows[at] |= uint64_t(1) << b;
                }
    }
};
inline constexpr BlocksOfBox kBlocksOfBox;

// Returns the bits of a depth. Depths are positive, so their bits have the same order.
V3DG_INLINE uint32_t depth_bits_of(float depth) {
    uint32_t bits;
    std::memcpy(&bits, &depth, sizeof bits);
    return bits;
}

// The format of an entry. From the highest bits on, an entry has the depth's bits minus
// the smallest depth's bits, the index of the record, and the box in the tile. If an
// integer is too small for all of these, the lowest bits of depths are dropped.
struct EntryFormat {
    static constexpr int kBoxBits = 12;
    int depth_shift = kBoxBits, dropped_bits = 0;
    uint32_t least_depth = 0;

    // Returns the format for record indices below num_records and depths whose bits are
    // from `least` to `most`.
    static constexpr EntryFormat of(uint64_t num_records, uint32_t least, uint32_t most) {
        EntryFormat f;
        f.least_depth = least;
        while (num_records << kBoxBits > uint64_t(1) << f.depth_shift) ++f.depth_shift;
        while (uint64_t(most - least) >> f.dropped_bits >> (64 - f.depth_shift) != 0)
            ++f.dropped_bits;
        return f;
    }
    V3DG_INLINE uint64_t entry(uint32_t depth_bits, uint64_t record, uint64_t box) const {
        return uint64_t((depth_bits - least_depth) >> dropped_bits) << depth_shift |
               record << kBoxBits | box;
    }
    V3DG_INLINE uint64_t record_of(uint64_t entry) const {
        return (entry & ((uint64_t(1) << depth_shift) - 1)) >> kBoxBits;
    }
    // Returns the blocks of the tile that the record's box meets.
    V3DG_INLINE static uint64_t blocks_of(uint64_t entry) {
        return kBlocksOfBox.columns[entry & 63] & kBlocksOfBox.rows[entry >> 6 & 63];
    }
};

}  // namespace v3dg
