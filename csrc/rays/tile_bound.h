#pragma once

// Lower bounds on the distances at which a gaussian is hit by the rays of one tile,
// for the host and for devices. They order the entries of the tile.

#include "rays/ray_grid.h"

namespace v3dg {

// Parts of a tile that are wider than this have no bound of their own, rad.
constexpr float kMostBoundedWidth = 0.7f;
// Margins of the bound for rounding: a share of the distance, and a share of the
// difference of the distances at the corners.
constexpr float kTileBoundMargin = 2e-5f, kTileBoundSpread = 0.01f;

// Returns the rays of a range that lie in the k-th of its tiles. Their columns do not
// wrap around. If the tile contains both ends of a range that wraps around, these are
// all of its columns.
V3DG_HD inline RayRange rays_in_tile(const RayDirections& rays, const RayRange& range,
                                     const RayTiles& tiles, uint32_t k) {
    const int num_columns = rays.num_columns();
    const int tile_column = tiles.column + static_cast<int>(k % tiles.num_columns);
    const int row = (tiles.row + static_cast<int>(k / tiles.num_columns)) * rays.tile_height;
    const bool is_wrapped = tile_column >= rays.tile_columns();
    const int first =
        (is_wrapped ? tile_column - rays.tile_columns() : tile_column) * rays.tile_width;
    const int end = first + rays.tile_width;
    const int last = (end < num_columns ? end : num_columns) - 1;
    const int last_row = row + rays.tile_height - 1;
    const int shift = is_wrapped ? num_columns : 0;
    RayRange part{.row0 = range.row0 > row ? range.row0 : row,
                  .row1 = range.row1 < last_row ? range.row1 : last_row,
                  .column0 = range.column0 - shift,
                  .column1 = range.column1 - shift};
    const bool has_both_ends = range.column1 - num_columns >= first && range.column0 <= last;
    if (part.column0 < first || has_both_ends) part.column0 = first;
    if (part.column1 > last || has_both_ends) part.column1 = last;
    return part;
}

// Returns a lower bound on the distances at which a gaussian is hit by the rays of
// `part`, whose columns do not wrap around. Returns 0 if the part is too wide, or if
// the gaussian is not in front of all of its corners.
//
// Let A = along^T along, and let D be a direction of any length. The gaussian has its
// largest value on it at the place t D with t(D) = (A p . D) / (D^T A D). The
// directions with 1 / t(D) <= c and A p . D > 0 are those with D^T A D <= c (A p . D),
// which form a convex set for each c. In a plane of directions, t is therefore least at
// a corner of any convex polygon that contains the part. The plane is u . D = 1 with
// the unit vector u of the middle, in which no D is shorter than 1.
//
// Lines of one azimuth are straight in the plane. Between its ends, a straight line
// from one azimuth to another is nearer to a pole than its ends are: its elevation e
// has tan(e) = tan(e_end) cos(azimuth) / cos(half_width), counted from its middle. So
// the edge of the polygon towards the equator is lowered by the factor cos(half_width).
V3DG_HD inline float nearest_in_tile(const RayShape<float>& shape, const RayDirections& rays,
                                     const RayRange& part) {
    const int c0 = part.column0, c1 = part.column1;
    const float width = rays.azimuth.angles[c1] - rays.azimuth.angles[c0];
    if (!(width >= 0 && width < kMostBoundedWidth)) return 0;
    const float cosine[2] = {rays.azimuth_cosine[c0], rays.azimuth_cosine[c1]};
    const float sine[2] = {rays.azimuth_sine[c0], rays.azimuth_sine[c1]};
    const float across[2] = {rays.elevation_cosine[part.row0], rays.elevation_cosine[part.row1]};
    float height[2] = {rays.elevation_sine[part.row0], rays.elevation_sine[part.row1]};
    // The cosine of half of the width is at least this.
    const float lowered = 1 - 0.125f * width * width;
    if (height[0] > 0) height[0] *= lowered;
    if (height[1] < 0) height[1] *= lowered;
    const float u[3] = {(across[0] + across[1]) * (cosine[0] + cosine[1]),
                        (across[0] + across[1]) * (sine[0] + sine[1]), 2 * (height[0] + height[1])};
    const float length = sqrt_of(dot3(u, u));
    float least = kLargest<float>, most = 0;
    for (int corner = 0; corner < 4; ++corner) {
        const int c = corner % 2, r = corner / 2;
        const float d[3] = {across[r] * cosine[c], across[r] * sine[c], height[r]};
        float below = 0;
        for (int k = 0; k < 3; ++k) {
            const float along = dot3(shape.along + 3 * k, d);
            below += along * along;
        }
        const float forward = dot3(shape.range, d), depth = dot3(u, d);
        const float distance = forward * depth / (below * length);
        if (!(forward > 0 && depth > 0 && distance < kLargest<float>)) return 0;
        least = min_of(least, distance);
        most = max_of(most, distance);
    }
    return max_of(least * (1 - kTileBoundMargin) - kTileBoundSpread * (most - least), 0.0f);
}

}  // namespace v3dg
