#pragma once

// The inner loops of blending on the CPU. They process one tile of 32 x 32 pixels,
// which fits into the L1 cache.
//
// A tile is divided into 8 x 8 blocks of 4 x 4 pixels, so a 64-bit mask has one bit per
// block. One mask marks the blocks that a gaussian may touch, and another the live
// blocks, in which at least one pixel has not stopped. If the two masks do not overlap,
// the gaussian costs only a few integer operations.

#include <cstdint>

#include "frame/entry.h"
#include "frame/image.h"
#include "frame/record.h"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace V3DG_ISA {

constexpr int kBlockPixels = kBlockSize * kBlockSize;
constexpr int kTilePixels = kTileSize * kTileSize;

// An optional value that is summed per pixel, in addition to colour and transmittance.
enum class Extra { kNothing, kDepth, kCount };

// The pixels of a tile, stored block by block with 16 pixels each.
template <class T>
struct TilePlanes {
    alignas(64) T transmittance[kTilePixels];
    alignas(64) T color[3][kTilePixels];
    alignas(64) T extra[kTilePixels];  // sum of weight * depth, or number of gaussians
};

// The gradients of a tile's pixels, in the layout that the backward pass reads.
template <class T>
struct TileGradient {
    alignas(64) T d_color[3][kTilePixels];
    // Gradient with respect to the sum of weight * depth.
    alignas(64) T d_depth[kTilePixels];
    alignas(
        // The part of the gradient with respect to a weight that is the same for all
        // gaussians. It comes from alpha and from the background that gaussians hide.
        64) T d_weight[kTilePixels];
    // Sum over gaussians of weight * (gradient with respect to the weight).
    alignas(64) T total[kTilePixels];
};

// Returns the blocks of the tile at (left, top) that the record's box touches.
template <class T>
V3DG_INLINE uint64_t blocks_of(const Record<T>& g, int left, int top) {
    const int x0 = (g.x0 > left ? g.x0 - left : 0) >> 2;
    const int y0 = (g.y0 > top ? g.y0 - top : 0) >> 2;
    const int x1 = (g.x1 - left < kTileSize ? g.x1 - left : kTileSize - 1) >> 2;
    const int y1 = (g.y1 - top < kTileSize ? g.y1 - top : kTileSize - 1) >> 2;
    return EntryFormat::blocks_of(static_cast<uint64_t>(x0 | x1 << 3 | y0 << 6 | y1 << 9));
}

// From this number of touched blocks on, the exact test of the ellipse saves time.
// Blocks are cheapest to draw if one vector covers a whole block.
constexpr int kFewBlocks = kLanes<float> == kBlockPixels ? 9 : 5;

// Returns the subset of `blocks` that the ellipse reaches. For each row of blocks, it
// computes the extent of the ellipse in x over the rows of pixel centres, with the
// margin of row_extent(). Values are truncated, because every instruction set can do
// this in one instruction.
template <class T>
V3DG_INLINE uint64_t blocks_of_ellipse(const Record<T>& g, int left, int top, uint64_t blocks) {
    if (__builtin_popcountll(blocks) < kFewBlocks) return blocks;
    const EllipseRows<T> ellipse = ellipse_rows(g.l11, g.l12, g.l22, g.log2_opacity);
    const T u = g.u - T(left) - T(0.5), v = g.v - T(top) - T(0.5);
    int first[kTileBlocks], last[kTileBlocks];
    for (int row = 0; row < kTileBlocks; ++row) {
        const T low = T(kBlockSize * row) - v;
        T x0, x1;
        row_extent(ellipse, low, low + T(kBlockSize - 1), x0, x1);
        x0 = min_of(max_of(u + x0, T(-1)), T(kTileSize));
        x1 = min_of(max_of(u + x1, T(-1)), T(kTileSize));
        first[row] = static_cast<int>(max_of(x0, T(0))) >> 2;
        last[row] = x1 < 0 ? -1 : static_cast<int>(x1) >> 2;
    }
    uint64_t mask = 0;
    for (int row = 0; row < kTileBlocks; ++row) {
        const int c0 = first[row], c1 = last[row] < kTileBlocks ? last[row] : kTileBlocks - 1;
        if (c0 > c1) continue;
        mask |= uint64_t((0xffu >> (kTileBlocks - 1 - c1)) & (0xffu << c0)) << (8 * row);
    }
    return blocks & mask;
}

// Returns the live blocks of the tile that the record may change. Precondition: the
// record's box touches the tile.
template <class T>
V3DG_INLINE uint64_t live_blocks(const Record<T>& g, int left, int top, uint64_t alive) {
    return blocks_of_ellipse(g, left, top, blocks_of(g, left, top) & alive);
}

// Clears a tile. Returns the blocks that have a pixel inside the window. Pixels outside
// the window are marked as stopped.
template <class T>
inline uint64_t clear_tile(TilePlanes<T>& tile, int left, int top, const Window& window,
                           Extra extra) {
    uint64_t alive = 0;
    for (int block = 0; block < kTileBlocks * kTileBlocks; ++block) {
        const int x = left + kBlockSize * (block % kTileBlocks),
                  y = top + kBlockSize * (block / kTileBlocks);
        if (x >= window.x1 || y >= window.y1 || x + kBlockSize <= window.x0 ||
            y + kBlockSize <= window.y0)
            continue;
        alive |= uint64_t(1) << block;
        for (int i = 0; i < kBlockPixels; ++i) {
            const int p = kBlockPixels * block + i;
            const int px = x + i % kBlockSize, py = y + i / kBlockSize;
            tile.transmittance[p] = window.contains(px, py) ? T(1) : T(-1);
            tile.color[0][p] = tile.color[1][p] = tile.color[2][p] = T(0);
            if (extra != Extra::kNothing) tile.extra[p] = T(0);
        }
    }
    return alive;
}

// Calls visit(index in the tile, index in the picture) for each pixel of the tile that
// is inside the window.
template <class Visit>
V3DG_INLINE void for_each_pixel(int left, int top, const Window& window, const Visit& visit) {
    for (int block = 0; block < kTileBlocks * kTileBlocks; ++block) {
        const int x0 = left + block % kTileBlocks * kBlockSize,
                  y0 = top + block / kTileBlocks * kBlockSize;
        for (int y = max_of(y0, window.y0); y < min_of(y0 + kBlockSize, window.y1); ++y)
            for (int x = max_of(x0, window.x0); x < min_of(x0 + kBlockSize, window.x1); ++x)
                visit(block * kBlockPixels + (y - y0) * kBlockSize + (x - x0),
                      static_cast<size_t>(y - window.y0) * window.width() + (x - window.x0));
    }
}

// The positions of a block's pixel centres.
template <class T>
struct BlockPixels {
    alignas(64) T x[kBlockPixels], y[kBlockPixels];  // relative to the block's corner
    // Offset of each row or column of blocks, repeated in every lane.
    alignas(64) T corner[kTileBlocks][kLanes<T>];
    BlockPixels() {
        for (int k = 0; k < kTileBlocks; ++k)
            for (T& lane : corner[k]) lane = T(kBlockSize * k);
        for (int i = 0; i < kBlockPixels; ++i) {
            x[i] = T(i % kBlockSize) + T(0.5);
            y[i] = T(i / kBlockSize) + T(0.5);
        }
    }
};

// Computes the gradients of one record. Returns false if no pixel contributes. It
// repeats the steps of blend_block() front to back, with the same operations, so that
// the same pixels contribute. `tile` must be cleared before the first record, and
// tile.color[0] then holds a running sum. `size` is only written if kWithSize is true.
template <class T, bool kWithDepth, bool kWithSize = false>
V3DG_INLINE bool blend_record_vjp(const Record<T>& g, uint64_t blocks, int left, int top,
                                  const BlockPixels<T>& pixels, const TileGradient<T>& grad,
                                  TilePlanes<T>& tile, uint64_t& alive, RecordGradient<T>& out,
                                  CenterSize<T>* size = nullptr) {
    using V = Vec<T>;
    const V l11 = all_lanes<V>(g.l11), l12 = all_lanes<V>(g.l12), l22 = all_lanes<V>(g.l22);
    const V log2_opacity = all_lanes<V>(g.log2_opacity);
    const T u = g.u - T(left), v = g.v - T(top);
    V s_t1 = V{}, s_t2 = V{}, s_t1_dx = V{}, s_t1_dy = V{}, s_t2_dy = V{}, s_exponent = V{};
    V s_color[3] = {V{}, V{}, V{}}, s_depth = V{};
    CenterSize<V> s_size{V{}, V{}};
    bool took_part = false;
    while (blocks != 0) {
        const int block = __builtin_ctzll(blocks);
        blocks &= blocks - 1;
        const V center_u = all_lanes<V>(u - T(kBlockSize * (block % kTileBlocks)));
        const V center_v = all_lanes<V>(v - T(kBlockSize * (block / kTileBlocks)));
        unsigned touched = 0, live = 0;
        for (int part = 0; part < kBlockPixels / kLanes<T>; ++part) {
            const V x = load(pixels.x + part * kLanes<T>), y = load(pixels.y + part * kLanes<T>);
            const Falloff<V> f = falloff_at(x, y, center_u, center_v, l11, l12, l22, log2_opacity);
            const int p = kBlockPixels * block + part * kLanes<T>;
            const V before = load(tile.transmittance + p);
            if (bits_of(contributes(f)) == 0) {
                live |= bits_of(before > V{});
                continue;
            }
            touched = 1;
            const V alpha = alpha_of(f);
            V t = before;
            const V weight = blend_weight(alpha, t);
            store(tile.transmittance + p, t);
            live |= bits_of(t > V{});

            V by_weight = load(grad.d_weight + p);
            for (int c = 0; c < 3; ++c) {
                const V d = load(grad.d_color[c] + p);
                by_weight += d * g.color[c];
                s_color[c] += d * weight;
            }
            if (kWithDepth) {
                const V d = load(grad.d_depth + p);
                by_weight += d * g.depth;
                s_depth += d * weight;
            }
            const V running = load(tile.color[0] + p) + weight * by_weight;
            store(tile.color[0] + p, running);
            const V d_exponent =
                exponent_vjp(alpha, before, weight, by_weight, load(grad.total + p) - running);
            const V d_t1 = -2 * f.t1 * d_exponent, d_t2 = -2 * f.t2 * d_exponent;
            s_exponent += d_exponent;
            s_t1 += d_t1;
            s_t2 += d_t2;
            s_t1_dx += d_t1 * f.dx;
            s_t1_dy += d_t1 * f.dy;
            s_t2_dy += d_t2 * f.dy;
            if (kWithSize) s_size += size_of_center_vjp(l11, l12, l22, f, d_exponent);
        }
        took_part |= touched != 0;
        if (live == 0) alive &= ~(uint64_t(1) << block);
    }
    if (!took_part) return false;
    out.ellipse = falloff_vjp(g.l11, g.l12, g.l22,
                              FalloffSums<T>{.exponent = sum_of(s_exponent),
                                             .t1 = sum_of(s_t1),
                                             .t2 = sum_of(s_t2),
                                             .t1_dx = sum_of(s_t1_dx),
                                             .t1_dy = sum_of(s_t1_dy),
                                             .t2_dy = sum_of(s_t2_dy)});
    for (int c = 0; c < 3; ++c) out.color[c] = sum_of(s_color[c]);
    out.ellipse.depth = kWithDepth ? sum_of(s_depth) : T(0);
    if (kWithSize) *size = {sum_of(s_size.u), sum_of(s_size.v)};
    return true;
}

}  // namespace V3DG_ISA
}  // namespace v3dg
