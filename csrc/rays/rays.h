#pragma once

// Casts the rays of a spherical sensor. All rays start at one point; a row has one
// elevation, and a column one azimuth. ray_math.h has the formulas, and returns.h finds
// the layers along a ray.
//
// Gaussians are projected in parallel, and their records are sorted into tiles of rays
// by the box of directions that they can reach. On each ray, gaussians are blended in
// the order of the distances at which they have their largest values. Equal distances
// are ordered by index, so the result does not depend on tiles or threads.

#include <cstdint>
#include <vector>

#include "base/isa.h"
#include "base/span.h"
#include "frame/draw_list.h"
#include "rays/ray_grid.h"
#include "rays/returns.h"

namespace v3dg {

// The directions of a sensor's rays, stored in host memory.
class RayGrid {
  public:
    // `row_place` and `column_place` give the row and the column of the picture for
    // each angle.
    RayGrid(Span<const double> azimuth, Span<const double> elevation, Span<const int32_t> row_place,
            Span<const int32_t> column_place);
    RayGrid(const RayGrid&) = delete;
    RayGrid& operator=(const RayGrid&) = delete;

    const RayDirections& directions() const { return directions_; }
    int num_columns() const { return directions_.num_columns(); }
    int num_rows() const { return directions_.num_rows(); }

    // The storage of one AngleTable.
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

// The results, one per ray, in the order of the picture. A plane that is null is not
// written.
struct RayPlanes {
    float* color;  // [rays][3], premultiplied
    float* alpha;  // [rays]
    float* range;  // [rays] mean distance, weighted by blend weights; 0 where nothing
                   // is hit
    // [rays] per return; either all of these pointers are null, or none is
    float *return_range[kMostReturns], *return_intensity[kMostReturns];
    ReturnRule rule;

    V3DG_HD bool has_returns() const { return return_range[0] != nullptr; }
    // Returns the planes with their pointers advanced to `ray`.
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

// A gaussian's hit on one ray of a tile.
struct TileHit {
    float range, alpha;
    uint32_t record;
};

// Scratch memory that one thread uses for the rays of a tile.
struct RayScratch {
    std::vector<TileHit> pending[kRayTileSize];
    ReturnFinder returns[kRayTileSize];
};

// Appends a record for each gaussian in [skip, skip + count) of a draw that may hit a
// ray.
V3DG_DECLARE_PER_ISA(void project_to_rays(const Draw<float>& draw, uint64_t skip, uint64_t count,
                                          const RayDirections& rays, const RayLimits& limits,
                                          std::vector<RayRecord>& records))

// Blends the rays of a tile. The low 32 bits of an entry are the index of its record.
// Entries must be sorted by the nearest distances of their records.
V3DG_DECLARE_PER_ISA(void cast_tile(const RayRecord* records, Span<const uint64_t> entries,
                                    const RayDirections& directions, size_t tile,
                                    const RayLimits& limits, RayScratch& scratch,
                                    const RayPlanes& planes))

namespace cpu {
// Casts all rays of a grid through the gaussians of `draws`.
void cast_rays(const std::vector<Draw<float>>& draws, const RayDirections& rays,
               const RayLimits& limits, const RayPlanes& planes);
}  // namespace cpu

}  // namespace v3dg
