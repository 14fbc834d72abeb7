#pragma once

// Blends one tile on the CPU, front to back. The records of a batch are assigned to the
// strips of blocks that they may change. Then each strip blends its records, with its
// pixels in registers.

#include "rasterize/tile_batch.h"

namespace v3dg {
namespace V3DG_ISA {

// Return the transmittance that live pixels stay above.
template <class T>
V3DG_INLINE T least_live(StopsBehind<T> stop) {
    return stop.transmittance;
}
template <class T>
V3DG_INLINE T least_live(StopsBefore) {
    return T(kMinTransmittance);
}

// Blends the batch over one strip of a block. Returns whether any of its pixels goes
// on.
template <class T, Extra kExtra, class Stop>
V3DG_INLINE bool blend_strip(const Batch<T>& batch, const StripRecords& records, int strip,
                             int block, const BlockPixels<T>& pixels, Stop stop,
                             TilePlanes<T>& tile) {
    using V = Vec<T>;
    constexpr unsigned kAllLanes = (1u << kLanes<T>)-1;
    const V block_u = load(pixels.corner[block % kTileBlocks]),
            block_v = load(pixels.corner[block / kTileBlocks]),
            least = all_lanes<V>(least_live<T>(stop));
    bool goes_on = false;
    for (int part = 0; part < kStripPixels / kLanes<T>; ++part) {
        const int in_block = kStripPixels * strip + part * kLanes<T>;
        const int p = kBlockPixels * block + in_block;
        const V x = load(pixels.x + in_block), y = load(pixels.y + in_block);
        V before = load(tile.transmittance + p), red = load(tile.color[0] + p),
          green = load(tile.color[1] + p), blue = load(tile.color[2] + p),
          extra = kExtra == Extra::kNothing ? V{} : load(tile.extra + p);
        unsigned live = kAllLanes & ~sign_bits_of(before);
        if (live == 0) continue;
        // Stopped lanes use a transmittance of 0, so that gaussians get no weight in
        // them. Their actual transmittance stays in `before`.
        V t = max_of(before, V{});
        StripRecords iterator = records;
        for (int k = records.size(); k != 0; --k) {
            const BatchRecord<T>& g = batch.record[iterator.next()];
            const Falloff<V> f = falloff_at(
                x, y, all_lanes<V>(g.u) - block_u, all_lanes<V>(g.v) - block_v, all_lanes<V>(g.l11),
                all_lanes<V>(g.l12), all_lanes<V>(g.l22), all_lanes<V>(g.log2_opacity));
            // Skip vectors without any contribution. If a vector covers a whole strip,
            // this is rare, so the test is left out.
            if (kLanes<T> < kStripPixels && bits_of(contributes(f)) == 0) continue;
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
    StripMask alive;
    alive.strip[0] = clear_tile(tile, left, top, window, kExtra);
    for (uint64_t& mask : alive.strip) mask = alive.strip[0];
    Batch<T> batch;
    for (size_t i = 0; i < count && alive.blocks() != 0;) {
        i = take_live(i, count, alive.blocks(), listed_at, batch);
        sort_into_strips(left, top, alive, batch);
        for (int s = 0; s < kStrips; ++s)
            for (uint64_t blocks = alive.strip[s]; blocks != 0; blocks &= blocks - 1) {
                const int block = __builtin_ctzll(blocks);
                const StripRecords records(batch.of_strip[s][block]);
                if (records.size() != 0 &&
                    !blend_strip<T, kExtra>(batch, records, s, block, pixels, stop, tile))
                    alive.strip[s] &= ~(uint64_t(1) << block);
            }
    }
}

}  // namespace V3DG_ISA
}  // namespace v3dg
