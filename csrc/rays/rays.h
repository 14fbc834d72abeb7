#pragma once

// Casts the rays of a spherical sensor: rows of one elevation, columns of one azimuth,
// all from one point. ray_math.h has the formulas, returns.h the layers of a ray.
//
// Gaussians are projected in parallel pieces, sorted into tiles of rays by the box of
// directions that they can reach, and blended on each ray in the order of the distances
// at which they have their largest values, ties by index. So the result does not depend
// on tiles or threads.

#include <cstdint>
#include <vector>

#include "base/isa.h"
#include "base/span.h"
#include "frame/draw_list.h"
#include "rays/ray_math.h"
#include "rays/returns.h"

namespace v3dg {

constexpr int kRayTileColumns = 16, kRayTileRows = 8;
constexpr int kRayTileSize = kRayTileColumns * kRayTileRows;

// Ascending angles, and where to begin a search among them.
class AngleTable {
  public:
    explicit AngleTable(Span<const double> angles);

    int size() const { return static_cast<int>(angles_.size()); }
    // Returns the index of the first angle that is not below `value`; 0 for NaN.
    int first_from(float value) const;
    // Returns the index of the last angle that is not above `value`, or -1.
    int last_up_to(float value) const;

  private:
    std::vector<float> angles_;
    std::vector<int32_t> first_in_bucket_;  // buckets of equal width
    float buckets_per_radian_;
};

// The directions of the rays. In view space x is forward, y left and z up; azimuths
// turn from x to y, and elevations are above the xy plane. The tables ascend; azimuths
// are in [0, 2 pi), elevations in [-pi/2, pi/2].
class RayGrid {
  public:
    RayGrid(Span<const double> azimuth, Span<const double> elevation);

    int num_columns() const { return azimuth_.size(); }
    int num_rows() const { return elevation_.size(); }
    int tile_columns() const { return (num_columns() + kRayTileColumns - 1) / kRayTileColumns; }
    int tile_rows() const { return (num_rows() + kRayTileRows - 1) / kRayTileRows; }
    size_t num_tiles() const { return size_t(tile_columns()) * tile_rows(); }
    size_t num_rays() const { return size_t(num_columns()) * num_rows(); }

    // The cosines and sines of the angles, padded with zeros to whole tiles.
    const float* azimuth_cosine() const { return azimuth_cosine_.data(); }
    const float* azimuth_sine() const { return azimuth_sine_.data(); }
    const float* elevation_cosine() const { return elevation_cosine_.data(); }
    const float* elevation_sine() const { return elevation_sine_.data(); }

    // The rays in a box of directions: rows and columns from the first to the last. The
    // last column may exceed the number of columns; columns then go on from 0.
    struct Range {
        int32_t row0, row1, column0, column1;

        bool is_empty() const { return row0 > row1 || column0 > column1; }
    };
    Range range_of(const DirectionBox<float>& box) const;

  private:
    AngleTable azimuth_, elevation_;
    std::vector<float> azimuth_cosine_, azimuth_sine_, elevation_cosine_, elevation_sine_;
};

// A gaussian that reaches rays. It fills two cache lines.
struct alignas(64) RayRecord {
    RayShape<float> shape;
    float color[3];
    float nearest;  // no ray has a hit in front of this distance
    RayGrid::Range range;
};

// The distances between which hits count, and how rays end.
struct RayLimits {
    float nearest, farthest;
    float spacing;            // px of a screen-space filter, in radians
    float min_transmittance;  // a ray ends when less than this is left
};

// The results, one per ray, row by row. Null planes are not written.
struct RayPlanes {
    float* color;     // [rays][3], premultiplied
    float* alpha;     // [rays]
    float* range;     // [rays] mean distance by blend weight; 0 where nothing is hit
    Return* returns;  // [rays][kMostReturns]
    ReturnRule rule;
};

// A gaussian on one ray of a tile.
struct TileHit {
    float range, alpha;
    uint32_t record;
};

// The memory of a thread for the rays of a tile.
struct RayScratch {
    std::vector<TileHit> pending[kRayTileSize];
    std::vector<Contribution> seen[kRayTileSize];
};

// Appends the records of gaussians [skip, skip + count) of a draw that reach a ray.
V3DG_DECLARE_PER_ISA(void project_to_rays(const Draw<float>& draw, uint64_t skip, uint64_t count,
                                          const RayGrid& grid, const RayLimits& limits,
                                          std::vector<RayRecord>& records))

// Blends the rays of a tile. The low 32 bits of an entry are the index of a record;
// entries ascend by the records' nearest distances.
V3DG_DECLARE_PER_ISA(void cast_tile(const RayRecord* records, Span<const uint64_t> entries,
                                    const RayGrid& grid, size_t tile, const RayLimits& limits,
                                    RayScratch& scratch, const RayPlanes& planes))

// The counts of a cast.
struct RayCounts {
    uint64_t records, entries;
    double project_seconds, bin_seconds, blend_seconds;
};

namespace cpu {
// Casts all rays of a grid through gaussians.
RayCounts cast_rays(const std::vector<Draw<float>>& draws, const RayGrid& grid,
                    const RayLimits& limits, const RayPlanes& planes);
}  // namespace cpu

}  // namespace v3dg
