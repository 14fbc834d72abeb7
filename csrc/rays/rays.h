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
#include "rays/ray_grid.h"
#include "rays/returns.h"

namespace v3dg {

// The directions of a sensor's rays, in host memory.
class RayGrid {
  public:
    // `row_place` and `column_place` are the row and the column of the picture for each
    // angle.
    RayGrid(Span<const double> azimuth, Span<const double> elevation, Span<const int32_t> row_place,
            Span<const int32_t> column_place);
    RayGrid(const RayGrid&) = delete;
    RayGrid& operator=(const RayGrid&) = delete;

    const RayDirections& directions() const { return directions_; }
    int num_columns() const { return directions_.num_columns(); }
    int num_rows() const { return directions_.num_rows(); }

    // The arrays of a table.
    struct Angles {
        std::vector<float> angles;
        std::vector<int32_t> first_in_bucket;
        float buckets_per_radian;
        std::vector<float> cosine, sine;  // padded with zeros to whole tiles
        std::vector<int32_t> place;

        Angles(Span<const double> values, Span<const int32_t> places, size_t tile);
    };
    const Angles& azimuth() const { return azimuth_; }
    const Angles& elevation() const { return elevation_; }

  private:
    Angles azimuth_, elevation_;
    RayDirections directions_;
};

// The results, one per ray, in the order of the picture. Null planes are not written.
struct RayPlanes {
    float* color;  // [rays][3], premultiplied
    float* alpha;  // [rays]
    float* range;  // [rays] mean distance by blend weight; 0 where nothing is hit
    // [rays] of each return; all or none are null
    float *return_range[kMostReturns], *return_intensity[kMostReturns];
    ReturnRule rule;

    V3DG_HD bool has_returns() const { return return_range[0] != nullptr; }
    // Returns the planes that begin at a ray.
    RayPlanes from(size_t ray) const {
        RayPlanes planes = *this;
        planes.alpha += ray;
        if (color != nullptr) planes.color += 3 * ray;
        if (range != nullptr) planes.range += ray;
        for (int k = 0; k < kMostReturns && has_returns(); ++k) {
            planes.return_range[k] += ray;
            planes.return_intensity[k] += ray;
        }
        return planes;
    }
};

// A gaussian on one ray of a tile.
struct TileHit {
    float range, alpha;
    uint32_t record;
};

// The memory of a thread for the rays of a tile.
struct RayScratch {
    std::vector<TileHit> pending[kRayTileSize];
    ReturnFinder returns[kRayTileSize];
};

// Appends the records of gaussians [skip, skip + count) of a draw that reach a ray.
V3DG_DECLARE_PER_ISA(void project_to_rays(const Draw<float>& draw, uint64_t skip, uint64_t count,
                                          const RayDirections& rays, const RayLimits& limits,
                                          std::vector<RayRecord>& records))

// Blends the rays of a tile. The low 32 bits of an entry are the index of a record;
// entries ascend by the records' nearest distances.
V3DG_DECLARE_PER_ISA(void cast_tile(const RayRecord* records, Span<const uint64_t> entries,
                                    const RayDirections& directions, size_t tile,
                                    const RayLimits& limits, RayScratch& scratch,
                                    const RayPlanes& planes))

namespace cpu {
// Casts all rays of a grid through gaussians.
void cast_rays(const std::vector<Draw<float>>& draws, const RayDirections& rays,
               const RayLimits& limits, const RayPlanes& planes);
}  // namespace cpu

}  // namespace v3dg
