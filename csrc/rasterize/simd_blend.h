#pragma once

// Blends one tile on the CPU, front to back. Records are processed in batches. First,
// the records of a batch are assigned to the blocks that they may change. Then, each
// block blends its records, with its pixels in registers.

#include <cstddef>
#include <cstring>

#include "rasterize/simd_tile.h"

namespace v3dg {
namespace V3DG_ISA {

// Maximum number of records in a batch. It is large enough that a block has several
// records, and small enough that a batch fits into the L1 cache.
constexpr int kBatchSize = 256;
// Maximum number of (record, block) pairs in a batch. It makes batches short if records
// are large, so that fewer records are loaded that turn out to be hidden.
constexpr int kBatchBlocks = 1024;

// The part of a record that blending reads first. The centre is relative to the tile's
// corner, in px.
template <class T>
struct BatchRecord {
    T u, v, l11, l12, l22, log2_opacity;
    T color[3];
    T depth;

    V3DG_INLINE void take(const Record<T>& g, int left, int top) {
        static_assert(
            sizeof *this <= sizeof g && offsetof(Record<T>, depth) == offsetof(BatchRecord, depth),
            "BatchRecord must have the layout of the first part of a Record");
        std::memcpy(static_cast<void*>(this), &g, sizeof *this);
        u = g.u - T(left);
        v = g.v - T(top);
    }
};

// Prefetches a record into the L2 cache, which supports more outstanding loads than the
// L1 cache. A record may straddle two cache lines, so both are prefetched.
template <class T>
V3DG_INLINE void prefetch_record(const Record<T>* record) {
    constexpr int kRead = 0, kSecondLevel = 2;
    __builtin_prefetch(record, kRead, kSecondLevel);
    __builtin_prefetch(reinterpret_cast<const char*>(record + 1) - 1, kRead, kSecondLevel);
}

// A batch of a tile's records, front to back, and the records of each block.
template <class T>
struct Batch {
    int size;
    const Record<T>* source[1 + kBatchSize];  // element 0 is only prefetched; the
                                              // records begin at 1
    uint64_t blocks[kBatchSize];              // blocks that each record may change
    BatchRecord<T> record[kBatchSize];
    uint16_t count[kTileBlocks * kTileBlocks];
    uint8_t place[kTileBlocks * kTileBlocks][kBatchSize];
};

// A record in a tile's list, and the blocks that its box touches.
template <class T>
struct Listed {
    const Record<T>* record;
    uint64_t blocks;
};

// Adds records to the batch until it is full, beginning with record i of the list.
// Returns the index of the next record. Only records whose boxes touch live blocks are
// added and loaded. The loop is branch-free, because a branch would often be
// mispredicted.
template <class T, class ListedAt>
V3DG_INLINE size_t take_live(size_t i, size_t count, uint64_t alive, const ListedAt& listed_at,
                             Batch<T>& batch) {
    int size = 0, num_blocks = 0;
    // Prefetch this record while the batch is empty.
    batch.source[0] = listed_at(i).record;
    for (; i < count && size < kBatchSize && num_blocks < kBatchBlocks; ++i) {
        const Listed<T> g = listed_at(i);
        const uint64_t blocks = g.blocks & alive;
        batch.source[1 + size] = g.record;
        batch.blocks[size] = blocks;
        size += blocks != 0;
        num_blocks += __builtin_popcountll(blocks);
        prefetch_record(batch.source[size]);
    }
    batch.size = size;
    return i;
}

// Reduces the blocks of each record to those that its ellipse reaches, and appends the
// record to their lists.
template <class T>
V3DG_INLINE void sort_into_blocks(int left, int top, Batch<T>& batch) {
    uint8_t many[kBatchSize];
    int num_many = 0;
    for (int i = 0; i < batch.size; ++i) {
        many[num_many] = static_cast<uint8_t>(i);
        num_many += __builtin_popcountll(batch.blocks[i]) >= kFewBlocks;
    }
    for (int k = 0; k < num_many; ++k) {
        uint64_t& blocks = batch.blocks[many[k]];
        blocks = blocks_of_ellipse(*batch.source[1 + many[k]], left, top, blocks);
    }
    for (uint16_t& n : batch.count) n = 0;
    for (int i = 0; i < batch.size; ++i) {
        batch.record[i].take(*batch.source[1 + i], left, top);
        for (uint64_t blocks = batch.blocks[i]; blocks != 0; blocks &= blocks - 1) {
            const int block = __builtin_ctzll(blocks);
            batch.place[block][batch.count[block]++] = static_cast<uint8_t>(i);
        }
    }
}

// Return the transmittance below which a live pixel stops.
template <class T>
V3DG_INLINE T least_live(StopsBehind<T> stop) {
    return stop.transmittance;
}
template <class T>
V3DG_INLINE T least_live(StopsBefore) {
    return T(kMinTransmittance);
}

// Blends the batch over one block. Returns whether any pixel of the block continues.
template <class T, Extra kExtra, class Stop>
V3DG_INLINE bool blend_block(const Batch<T>& batch, int block, const BlockPixels<T>& pixels,
                             Stop stop, TilePlanes<T>& tile) {
    using V = Vec<T>;
    constexpr unsigned kAllLanes = (1u << kLanes<T>)-1;
    const V block_u = load(pixels.corner[block % kTileBlocks]),
            block_v = load(pixels.corner[block / kTileBlocks]),
            least = all_lanes<V>(least_live<T>(stop));
    const uint8_t* place = batch.place[block];
    const uint8_t* end = place + batch.count[block];
    bool goes_on = false;
    for (int part = 0; part < kBlockPixels / kLanes<T>; ++part) {
        const int p = kBlockPixels * block + part * kLanes<T>;
        const V x = load(pixels.x + part * kLanes<T>), y = load(pixels.y + part * kLanes<T>);
        V before = load(tile.transmittance + p), red = load(tile.color[0] + p),
          green = load(tile.color[1] + p), blue = load(tile.color[2] + p),
          extra = kExtra == Extra::kNothing ? V{} : load(tile.extra + p);
        unsigned live = kAllLanes & ~sign_bits_of(before);
        if (live == 0) continue;
        // Stopped lanes use a transmittance of 0, so that gaussians get no weight in
        // them. Their actual transmittance stays in `before`.
        V t = max_of(before, V{});
        for (const uint8_t* at = place; at != end; ++at) {
            const BatchRecord<T>& g = batch.record[*at];
            const Falloff<V> f = falloff_at(
                x, y, all_lanes<V>(g.u) - block_u, all_lanes<V>(g.v) - block_v, all_lanes<V>(g.l11),
                all_lanes<V>(g.l12), all_lanes<V>(g.l22), all_lanes<V>(g.log2_opacity));
            // Skip vectors without any contribution. If one vector covers a whole
            // block, this is so rare that the test costs more than it saves.
            if (kLanes<T> < kBlockPixels && bits_of(contributes(f)) == 0) continue;
            const V alpha = alpha_of(f), behind = transmittance_behind(alpha, t);
            V weight = alpha * t;
            // Lanes seldom stop. If one subtraction shows that none stops, only the
            // product is carried over to the next record.
            if (sign_bits_of(least - behind) == live) {
                t = behind;
            } else {
                before = t > V{} ? t : before;
                weight = blend_weight(alpha, before, stop);
                t = max_of(before, V{});
                live = kAllLanes & ~sign_bits_of(before);
            }
            red += weight * all_lanes<V>(g.color[0]);
            green += weight * all_lanes<V>(g.color[1]);
            blue += weight * all_lanes<V>(g.color[2]);
            if (kExtra == Extra::kDepth) extra += weight * all_lanes<V>(g.depth);
            if (kExtra == Extra::kCount) extra += weight > V{} ? all_lanes<V>(T(1)) : V{};
            if (live == 0) break;
        }
        store(tile.transmittance + p, t > V{} ? t : before);
        store(tile.color[0] + p, red);
        store(tile.color[1] + p, green);
        store(tile.color[2] + p, blue);
        if (kExtra != Extra::kNothing) store(tile.extra + p, extra);
        goes_on |= live != 0;
    }
    return goes_on;
}

// Clears the tile, and blends `count` records front to back. listed_at(i) returns
// record i.
template <class T, Extra kExtra, class Stop, class ListedAt>
V3DG_INLINE void blend_tile(size_t count, int left, int top, const Window& window, Stop stop,
                            TilePlanes<T>& tile, const ListedAt& listed_at) {
    const BlockPixels<T> pixels;
    uint64_t alive = clear_tile(tile, left, top, window, kExtra);
    Batch<T> batch;
    for (size_t i = 0; i < count && alive != 0;) {
        i = take_live(i, count, alive, listed_at, batch);
        sort_into_blocks(left, top, batch);
        for (uint64_t blocks = alive; blocks != 0; blocks &= blocks - 1) {
            const int block = __builtin_ctzll(blocks);
            if (batch.count[block] != 0 &&
                !blend_block<T, kExtra>(batch, block, pixels, stop, tile))
                alive &= ~(uint64_t(1) << block);
        }
    }
}

}  // namespace V3DG_ISA
}  // namespace v3dg
