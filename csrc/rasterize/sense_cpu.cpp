// The sensor pass over one tile, on one CPU thread. It repeats the steps of
// blend_block() front to back, with the same operations, so that the same gaussians
// contribute with the same weights.

#include "rasterize/sense.h"

#include "rasterize/sense_math.h"
#include "rasterize/simd_blend.h"

namespace v3dg {
namespace V3DG_ISA {

// Which sums a tile needs.
struct SenseSums {
    bool median, normal, strongest, color, depth;
};

// The sums of a tile's pixels, block by block, and the state of their meshes.
struct SenseTile {
    TilePlanes<float> blended;  // `extra` holds the sum of weight times depth
    alignas(64) float normal[3][kTilePixels];
    alignas(64) float weight[kTilePixels];  // largest weight
    alignas(64) float median[kTilePixels];
    // Fraction of the light that the meshes in front let through.
    alignas(64) float passes[kTilePixels];
    // Depth of the mesh while gaussians in front of it are blended, then infinity.
    alignas(64) float mesh_depth[kTilePixels];
    uint32_t record[kTilePixels];
    // Used with meshes: the sums of the gaussians in front of the mesh, and the mesh.
    SensedSums front[kTilePixels];
    SensedMesh mesh[kTilePixels];
};

static V3DG_INLINE SensedSums sums_at(const SenseTile& tile, const SenseSums& sums, int p) {
    SensedSums out{{}, 0, {}, 0, kMeshRecord};
    for (int c = 0; c < 3 && sums.color; ++c) out.color[c] = tile.blended.color[c][p];
    if (sums.depth) out.depth = tile.blended.extra[p];
    for (int k = 0; k < 3 && sums.normal; ++k) out.normal[k] = tile.normal[k][p];
    if (sums.strongest) {
        out.weight = tile.weight[p];
        out.record = tile.record[p];
    }
    return out;
}

static V3DG_INLINE void clear_sums(SenseTile& tile, int p) {
    for (int k = 0; k < 3; ++k) tile.blended.color[k][p] = tile.normal[k][p] = 0;
    tile.blended.extra[p] = 0;
    tile.weight[p] = 0;
    tile.record[p] = kMeshRecord;
}

// Clears the tile. Returns the blocks that have a pixel inside the window.
static uint64_t start_tile(int left, int top, const Window& window, const MeshLayer& layer,
                           SenseTile& tile) {
    const uint64_t alive = clear_tile(tile.blended, left, top, window, Extra::kDepth);
    for (uint64_t blocks = alive; blocks != 0; blocks &= blocks - 1) {
        const int first = kBlockPixels * __builtin_ctzll(blocks);
        for (int p = first; p < first + kBlockPixels; ++p) {
            clear_sums(tile, p);
            tile.median[p] = 0;
            tile.passes[p] = 1;
            tile.mesh_depth[p] = kInfinite<float>;
        }
    }
    if (layer.is_there())
        for_each_pixel(left, top, window, [&](int p, size_t at) {
            tile.front[p] = {{}, 0, {}, 0, kMeshRecord};
            tile.mesh[p] = {layer.coverage[at], layer.depth[at], 0};
            if (layer.coverage[at] > 0) tile.mesh_depth[p] = layer.depth[at];
        });
    return alive;
}

// Stores a pixel's sums up to its mesh, and starts the sums behind the mesh.
static V3DG_INLINE void reach_mesh(const SenseSums& sums, SenseTile& tile, int p) {
    float& t = tile.blended.transmittance[p];
    SensedMesh& mesh = tile.mesh[p];
    tile.front[p] = sums_at(tile, sums, p);
    clear_sums(tile, p);
    mesh.passed = t;
    tile.mesh_depth[p] = kInfinite<float>;
    tile.passes[p] = 1 - mesh.coverage;
    tile.median[p] = median_after(tile.median[p], t, tile.passes[p], mesh.depth);
    if (mesh.coverage >= 1) t = -t;
}

// Calls reach_mesh() for those pixels of a vector whose mesh is not behind `depth`.
static V3DG_INLINE void reach_meshes(const SenseSums& sums, float depth, SenseTile& tile, int p) {
    using V = Vec<float>;
    const V t = load(tile.blended.transmittance + p);
    const auto is_reached = (all_lanes<V>(depth) >= load(tile.mesh_depth + p)) & (t > V{});
    for (unsigned lanes = bits_of(is_reached); lanes != 0; lanes &= lanes - 1)
        reach_mesh(sums, tile, p + __builtin_ctz(lanes));
}

// Adds a record to the sums of a vector of pixels.
static V3DG_INLINE void add_weights(const Record<float>& g, uint32_t record, const float* normal,
                                    const SenseSums& sums, Vec<float> weight, Vec<float> t,
                                    SenseTile& tile, int p) {
    using V = Vec<float>;
    const auto add = [&](float* sum, float value) {
        store(sum + p, load(sum + p) + weight * all_lanes<V>(value));
    };
    if (sums.median)
        store(tile.median + p,
              median_after(load(tile.median + p), t, load(tile.passes + p), all_lanes<V>(g.depth)));
    for (int c = 0; c < 3 && sums.color; ++c) add(tile.blended.color[c], g.color[c]);
    if (sums.depth) add(tile.blended.extra, g.depth);
    for (int k = 0; k < 3 && sums.normal; ++k) add(tile.normal[k], normal[k]);
    if (!sums.strongest) return;
    const V most = load(tile.weight + p);
    const auto is_more = weight > most;
    store(tile.weight + p, is_more ? weight : most);
    for (unsigned lanes = bits_of(is_more); lanes != 0; lanes &= lanes - 1)
        tile.record[p + __builtin_ctz(lanes)] = record;
}

// Blends a record over some blocks. Removes blocks from `alive` if all of their pixels
// have stopped.
template <class Stop>
static V3DG_INLINE void sense_record(const Record<float>& g, uint32_t record, const float* normal,
                                     uint64_t blocks, int left, int top,
                                     const BlockPixels<float>& pixels, bool has_mesh,
                                     const SenseSums& sums, Stop stop, SenseTile& tile,
                                     uint64_t& alive) {
    using V = Vec<float>;
    const V l11 = all_lanes<V>(g.l11), l12 = all_lanes<V>(g.l12), l22 = all_lanes<V>(g.l22);
    const V log2_opacity = all_lanes<V>(g.log2_opacity);
    const V u = all_lanes<V>(g.u - float(left)), v = all_lanes<V>(g.v - float(top));
    for (; blocks != 0; blocks &= blocks - 1) {
        const int block = __builtin_ctzll(blocks);
        const V center_u = u - load(pixels.corner[block % kTileBlocks]);
        const V center_v = v - load(pixels.corner[block / kTileBlocks]);
        unsigned live = 0;
        for (int part = 0; part < kBlockPixels / kLanes<float>; ++part) {
            const int p = kBlockPixels * block + part * kLanes<float>;
            if (has_mesh) reach_meshes(sums, g.depth, tile, p);
            const V x = load(pixels.x + part * kLanes<float>),
                    y = load(pixels.y + part * kLanes<float>);
            const Falloff<V> f = falloff_at(x, y, center_u, center_v, l11, l12, l22, log2_opacity);
            V t = load(tile.blended.transmittance + p);
            if (bits_of(contributes(f)) != 0) {
                const V weight = blend_weight(alpha_of(f), t, stop);
                store(tile.blended.transmittance + p, t);
                add_weights(g, record, normal, sums, weight, t, tile, p);
            }
            live |= bits_of(t > V{});
        }
        if (live == 0) alive &= ~(uint64_t(1) << block);
    }
}

// Writes the channels of the tile's pixels.
static void write_channels(const SenseTile& tile, const SenseSums& sums,
                           const SensedRecords& sensed, int left, int top,
                           const Picture<float>& picture, const Sensor& sensor) {
    const SensedSums nothing{{}, 0, {}, 0, kMeshRecord};
    for_each_pixel(left, top, picture.window, [&](int p, size_t at) {
        const SensedSums last = sums_at(tile, sums, p);
        const bool has_mesh = sensor.mesh.is_there() && tile.mesh[p].coverage > 0;
        const SensedPixel pixel{.transmittance = tile.blended.transmittance[p],
                                .median_depth = tile.median[p],
                                .mesh = has_mesh ? tile.mesh[p] : SensedMesh{0, 0, 0},
                                .front = has_mesh ? tile.front[p] : last,
                                .behind = has_mesh ? last : nothing};
        write_pixel(pixel, at, picture.min_transmittance, sensed, sensor, picture);
    });
}

// Finishes the meshes of a tile. Meshes behind all gaussians are reached now. A pixel
// with a hidden mesh is treated as a pixel without a mesh.
static void end_meshes(int left, int top, const Window& window, const SenseSums& sums,
                       SenseTile& tile) {
    for_each_pixel(left, top, window, [&](int p, size_t) {
        if (!(tile.mesh_depth[p] < kInfinite<float>)) return;
        if (tile.blended.transmittance[p] > 0)
            reach_mesh(sums, tile, p);
        else
            tile.mesh[p].coverage = 0;
    });
}

void sense_tile(const Record<float>* records, const SensedRecords& sensed, EntryFormat format,
                const uint64_t* entry, size_t count, int left, int top,
                const Picture<float>& picture, const Sensor& sensor) {
    constexpr size_t kPrefetch = 48;  // records are prefetched this far ahead
    const bool has_mesh = sensor.mesh.is_there();
    const SenseSums sums{.median = sensor.planes.median_depth != nullptr,
                         .normal = sensor.planes.normal != nullptr,
                         .strongest = sensor.planes.wants_strongest(),
                         .color = has_mesh,
                         .depth = has_mesh && picture.depth != nullptr};
    const BlockPixels<float> pixels;
    SenseTile tile;
    uint64_t alive = start_tile(left, top, picture.window, sensor.mesh, tile);
    with_stop<float>(picture.min_transmittance, [&](auto stop) {
        for (size_t i = 0; i < count && alive != 0; ++i) {
            if (i + kPrefetch < count)
                prefetch_record(records + format.record_of(entry[i + kPrefetch]));
            const auto record = static_cast<uint32_t>(format.record_of(entry[i]));
            const Record<float>& g = records[record];
            const uint64_t blocks =
                blocks_of_ellipse(g, left, top, EntryFormat::blocks_of(entry[i]) & alive);
            const float* normal = sums.normal ? sensed.normal + 3 * size_t(record) : nullptr;
            sense_record(g, record, normal, blocks, left, top, pixels, has_mesh, sums, stop, tile,
                         alive);
        }
    });
    if (has_mesh) end_meshes(left, top, picture.window, sums, tile);
    write_channels(tile, sums, sensed, left, top, picture, sensor);
}

}  // namespace V3DG_ISA
}  // namespace v3dg
