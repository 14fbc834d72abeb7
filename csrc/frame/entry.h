#pragma once

// An entry of a tile's list on the CPU. One integer holds a record's depth, index and
// blocks. tile_list.h has the format for CUDA.

#include <cstdint>
#include <cstring>

#include "frame/image.h"

namespace v3dg {

constexpr int kBlockSize = 4;  // width and height of a block of pixels
constexpr int kTileBlocks = kTileSize / kBlockSize;

// Tables that convert the range of block columns, or rows, of a box to a mask of the
// tile's blocks. The lower 3 bits of the index are the first column, and the upper 3
// bits the last column. The mask has one bit per block, row by row.
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

// Returns the bits of a depth. Bits of positive floats have the same order as the
// floats.
V3DG_INLINE uint32_t depth_bits_of(float depth) {
    uint32_t bits;
    std::memcpy(&bits, &depth, sizeof bits);
    return bits;
}

// The bit layout of entries. From the highest bit down, an entry has the bits of the
// depth minus those of the smallest depth, the index of the record, and the record's
// box in the tile. If 64 bits do not suffice, the lowest bits of the depths are
// dropped.
struct EntryFormat {
    static constexpr int kBoxBits = 12;
    int depth_shift = kBoxBits, dropped_bits = 0;
    uint32_t least_depth = 0;

    // Returns the format for up to `num_records` records whose depths have bits from
    // `least` to `most`.
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
    // Returns a mask of the tile's blocks that the record's box touches.
    V3DG_INLINE static uint64_t blocks_of(uint64_t entry) {
        return kBlocksOfBox.columns[entry & 63] & kBlocksOfBox.rows[entry >> 6 & 63];
    }
};

}  // namespace v3dg
