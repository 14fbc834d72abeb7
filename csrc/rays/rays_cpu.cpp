// Projects gaussians to rays, and blends rays, on the CPU. Projection processes a
// vector of gaussians at once; blending processes a vector of rays. This file is
// compiled once per instruction set.

#include "rays/rays.h"

#include <algorithm>

#include "math/instance_factors.h"
#include "project/host_sources.h"

namespace v3dg {
namespace V3DG_ISA {

using V = Vec<float>;

// Hits of rays are blended each time after this number of gaussians.
constexpr size_t kFlushed = 32;
// Records are prefetched this many entries ahead.
constexpr size_t kAhead = 6;

static V3DG_INLINE RayShape<float> lane_of(const RayShape<V>& shape, int i) {
    RayShape<float> one;
    for (int k = 0; k < 9; ++k) {
        one.across[k] = shape.across[k][i];
        one.along[k] = shape.along[k][i];
    }
    for (int k = 0; k < 3; ++k) one.range[k] = shape.range[k][i];
    one.log2_opacity = shape.log2_opacity[i];
    return one;
}

// Computes the colours of the gaussians for which bit k of `lanes` is set.
template <class Source>
static V3DG_INLINE void colors_of(const Source& from, const Draw<float>& draw, uint64_t at,
                                  uint64_t count, unsigned lanes, const V mean[3], V color[3]) {
    V direction[3];
    from_eye(draw.view, mean, direction);
    if (draw.palette.sh != nullptr) {
        V sh[3];
        load_palette(draw.palette, at, lanes, sh);
        color_of_sh(0, direction, sh, color);
        return;
    }
    from.color_of(at, count, direction, color);
    if (draw.color_factors != nullptr) tint(draw.color_factors, color);
}

template <class Source>
static void project_rows(const Source& from, const Draw<float>& draw, uint64_t first,
                         uint64_t count, const RayDirections& rays, const RayLimits& limits,
                         std::vector<RayRecord>& records) {
    constexpr int kWidth = kLanes<float>;
    const float filter_rad2 = draw.appearance.filter_px2 * limits.spacing * limits.spacing;
    for (uint64_t done = 0; done < count; done += kWidth) {
        const uint64_t at = first + done;
        const unsigned lanes =
            count - done >= kWidth ? (1u << kWidth) - 1 : (1u << (count - done)) - 1;
        const Gaussian3d<V> g = from.load_gaussians(at, count - done);
        SeenGaussian<V> seen = see_gaussian(g, draw.view, filter_rad2, draw.appearance.antialiased,
                                            draw.appearance.is_limited);
        if (draw.weight < 1) seen.log2_opacity += log2_of(draw.weight);
        const unsigned visible = bits_of(is_visible(seen, g.opacity)) & lanes;
        if (visible == 0) continue;
        const V reach2 =
            (seen.log2_opacity - float(kLog2MinAlpha)) * float(1 / (kFalloffScale * kFalloffScale));
        const V nearest = nearest_of(seen, reach2);
        const DirectionBox<V> box = directions_of(seen, reach2);
        unsigned kept = 0;
        RayRange range[kWidth];
        const auto is_near = nearest <= all_lanes<V>(limits.farthest);
        for (unsigned left = visible & bits_of(is_near); left != 0; left &= left - 1) {
            const int i = __builtin_ctz(left);
            range[i] = rays.range_of(
                {box.azimuth0[i], box.azimuth1[i], box.elevation0[i], box.elevation1[i]});
            if (!range[i].is_empty()) kept |= 1u << i;
        }
        if (kept == 0) continue;
        const RayShape<V> shape = shape_on_rays(seen);
        V color[3];
        colors_of(from, draw, at, count - done, kept, g.mean, color);
        for (; kept != 0; kept &= kept - 1) {
            const int i = __builtin_ctz(kept);
            records.push_back({.shape = lane_of(shape, i),
                               .order = 0,
                               .nearest = nearest[i],
                               .color = {color[0][i], color[1][i], color[2][i]},
                               .range = range[i]});
        }
    }
}

void project_to_rays(const Draw<float>& draw, uint64_t skip, uint64_t count,
                     const RayDirections& rays, const RayLimits& limits,
                     std::vector<RayRecord>& records) {
    if (draw.codes == nullptr) {
        project_rows(PlaneSource<float>{*draw.model}, draw, draw.first + skip, count, rays, limits,
                     records);
        return;
    }
    for_clusters(*draw.codes, draw.first + skip, count,
                 [&](const CodeSource& source, uint64_t first, uint64_t size) {
                     project_rows(source, draw, first, size, rays, limits, records);
                 });
}

// The state of a tile's rays during blending.
struct TileRays {
    float transmittance[kRayTileSize];
    float color[kRayTileSize][3];
    float weighted_range[kRayTileSize];
    int num_open;  // number of rays that have not ended

    bool is_open(int ray) const { return transmittance[ray] > 0; }
    void close(int ray) {
        transmittance[ray] = 0;
        --num_open;
    }
};

// Blends a ray's pending hits that are closer than `end`, and keeps the others.
static void blend_pending(const RayRecord* records, float end, const RayLimits& limits, int ray,
                          bool has_returns, RayScratch& scratch, TileRays& rays, float& left) {
    std::vector<TileHit>& pending = scratch.pending[ray];
    std::sort(pending.begin(), pending.end(), [](const TileHit& a, const TileHit& b) {
        return a.range != b.range ? a.range < b.range : a.record < b.record;
    });
    size_t blended = 0;
    for (; blended < pending.size() && pending[blended].range < end; ++blended) {
        const TileHit& hit = pending[blended];
        const float weight = hit.alpha * rays.transmittance[ray];
        const float* rgb = records[hit.record].color;
        for (int c = 0; c < 3; ++c) rays.color[ray][c] += weight * rgb[c];
        rays.weighted_range[ray] += weight * hit.range;
        if (has_returns)
            scratch.returns[ray].add({hit.range, weight, luma_of(rgb)}, rays.transmittance[ray]);
        rays.transmittance[ray] *= 1 - hit.alpha;
        if (rays.transmittance[ray] < limits.min_transmittance) {
            left = rays.transmittance[ray];
            rays.close(ray);
            pending.clear();
            return;
        }
    }
    pending.erase(pending.begin(), pending.begin() + static_cast<std::ptrdiff_t>(blended));
}

// Adds the hits of one gaussian to the rays of one row of a tile. `x`, `y` and `z` are
// the directions of the rays. Bit k of `vectors` is set if the gaussian may hit rays of
// vector k.
static V3DG_INLINE void hit_row(const RayRecord& record, uint32_t index, const RayLimits& limits,
                                unsigned vectors, int first_ray, const float* x, const float* y,
                                float z, const TileRays& rays, RayScratch& scratch) {
    const V reach = all_lanes<V>(record.shape.log2_opacity - float(kLog2MinAlpha));
    for (; vectors != 0; vectors &= vectors - 1) {
        const int c = __builtin_ctz(vectors) * kLanes<float>;
        const RayHit<V> hit = hit_of(record.shape, load(x + c), load(y + c), all_lanes<V>(z));
        const auto is_hit = (hit.falloff <= reach) & (hit.range >= all_lanes<V>(limits.nearest)) &
                            (hit.range <= all_lanes<V>(limits.farthest));
        unsigned bits = bits_of(is_hit);
        if (bits == 0) continue;
        // Raising alpha to at least 1/255 has an effect only in lanes that are not hit.
        const V log2_alpha =
            max_of(record.shape.log2_opacity - hit.falloff, all_lanes<V>(float(kLog2MinAlpha - 1)));
        const V alpha = min_of(exp2_in_range(log2_alpha), all_lanes<V>(float(kMaxAlpha)));
        // Rounding must not put a hit in front of the bound that orders the entries.
        const V range = max_of(hit.range, all_lanes<V>(record.nearest));
        for (; bits != 0; bits &= bits - 1) {
            const int i = __builtin_ctz(bits), ray = first_ray + c + i;
            if (rays.is_open(ray)) scratch.pending[ray].push_back({range[i], alpha[i], index});
        }
    }
}

// Returns a mask of the vectors of a tile's row that contain a column of the range.
// `column` is the first column of the tile.
static V3DG_INLINE unsigned vectors_of(const RayRange& range, int column, int num_columns) {
    unsigned vectors = 0;
    for (int c = 0; c < kRayTileColumns; c += kLanes<float>) {
        const int first = column + c, last = first + kLanes<float> - 1;
        const bool is_reached = first <= range.column1 && last >= range.column0;
        const bool is_reached_again = first + num_columns <= range.column1;
        if (is_reached || is_reached_again) vectors |= 1u << (c / kLanes<float>);
    }
    return vectors;
}

void cast_tile(const RayRecord* records, Span<const uint64_t> entries,
               const RayDirections& directions, size_t tile, const RayLimits& limits,
               RayScratch& scratch, const RayPlanes& planes) {
    const int column = static_cast<int>(tile % directions.tile_columns()) * kRayTileColumns;
    const int row = static_cast<int>(tile / directions.tile_columns()) * kRayTileRows;
    const int num_columns = std::min(kRayTileColumns, directions.num_columns() - column);
    const int num_rows = std::min(kRayTileRows, directions.num_rows() - row);
    const bool has_returns = planes.has_returns();
    TileRays rays{};
    float left[kRayTileSize];  // final transmittance of each ray
    float x[kRayTileSize], y[kRayTileSize];
    for (int r = 0; r < num_rows; ++r)
        for (int c = 0; c < kRayTileColumns; ++c) {
            const int ray = kRayTileColumns * r + c;
            x[ray] = directions.elevation_cosine[row + r] * directions.azimuth_cosine[column + c];
            y[ray] = directions.elevation_cosine[row + r] * directions.azimuth_sine[column + c];
            rays.transmittance[ray] = c < num_columns ? 1.0f : 0.0f;
            scratch.pending[ray].clear();
            if (has_returns) scratch.returns[ray].start(planes.rule);
        }
    rays.num_open = num_rows * num_columns;
    const auto blend_before = [&](float end) {
        for (int ray = 0; ray < num_rows * kRayTileColumns; ++ray)
            if (!scratch.pending[ray].empty())
                blend_pending(records, end, limits, ray, has_returns, scratch, rays, left[ray]);
    };
    for (size_t e = 0; e < entries.size && rays.num_open > 0; ++e) {
        if (e + kAhead < entries.size) {
            const RayRecord* next = records + static_cast<uint32_t>(entries[e + kAhead]);
            __builtin_prefetch(next);
            __builtin_prefetch(reinterpret_cast<const char*>(next) + 64);
        }
        const auto index = static_cast<uint32_t>(entries[e]);
        const RayRecord& record = records[index];
        if (e % kFlushed == kFlushed - 1) blend_before(record.nearest);
        const int last = std::min(record.range.row1 - row, num_rows - 1);
        const unsigned vectors = vectors_of(record.range, column, directions.num_columns());
        for (int r = std::max(record.range.row0 - row, 0); r <= last; ++r) {
            const int first_ray = kRayTileColumns * r;
            hit_row(record, index, limits, vectors, first_ray, x + first_ray, y + first_ray,
                    directions.elevation_sine[row + r], rays, scratch);
        }
    }
    blend_before(INFINITY);
    for (int r = 0; r < num_rows; ++r)
        for (int c = 0; c < num_columns; ++c) {
            const int ray = kRayTileColumns * r + c;
            const size_t out = directions.place(row + r, column + c);
            const float passed = rays.is_open(ray) ? rays.transmittance[ray] : left[ray];
            const float alpha = 1 - passed;
            planes.alpha[out] = alpha;
            if (planes.color != nullptr)
                for (int k = 0; k < 3; ++k) planes.color[3 * out + k] = rays.color[ray][k];
            if (planes.range != nullptr)
                planes.range[out] = alpha > 0 ? rays.weighted_range[ray] / alpha : 0;
            if (!has_returns) continue;
            scratch.returns[ray].finish();
            for (int k = 0; k < kMostReturns; ++k) {
                planes.return_range[k][out] = scratch.returns[ray].found(k).range;
                planes.return_intensity[k][out] = scratch.returns[ray].found(k).intensity;
            }
        }
}

}  // namespace V3DG_ISA
}  // namespace v3dg
