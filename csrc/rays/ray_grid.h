#pragma once

// The directions of a sensor's rays, and the search for the rays inside a box of
// directions. Shared by host and device; RayGrid in rays.h owns the memory.

#include <cstddef>
#include <cstdint>

#include "rays/ray_math.h"

namespace v3dg {

// The tiles of the CPU. Tables are padded to whole ones; tiles of a device divide them.
constexpr int kRayTileColumns = 16, kRayTileRows = 8;
constexpr int kRayTileSize = kRayTileColumns * kRayTileRows;
constexpr float kTurn = static_cast<float>(2 * kPi);

// Angles in ascending order, with a table of buckets that shortens the search.
struct AngleTable {
    const float* angles;
    const int32_t* first_in_bucket;  // [size + 1] buckets of equal width
    int size;
    float buckets_per_radian;

    // Returns the index of the first angle that is not below `value`; 0 for NaN.
    V3DG_HD int first_from(float value) const {
        const float first = angles[0];
        if (!(value > first)) return 0;
        if (value > angles[size - 1]) return size;
        const int bucket = static_cast<int>((value - first) * buckets_per_radian);
        int i = first_in_bucket[bucket < size ? bucket : size];
        // Rounding may select a neighbouring bucket, so search from there.
        while (i > 0 && angles[i - 1] >= value) --i;
        while (angles[i] < value) ++i;
        return i;
    }
    // Returns the index of the last angle that is not above `value`, or -1.
    V3DG_HD int last_up_to(float value) const {
        int i = first_from(value);
        while (i < size && angles[i] <= value) ++i;
        return i - 1;
    }
};

// The rays inside a box of directions, as ranges of rows and columns. Both ends are
// included. If the range wraps around, column1 exceeds the number of columns; subtract
// that number to get the column.
struct RayRange {
    int32_t row0, row1, column0, column1;

    V3DG_HD bool is_empty() const { return row0 > row1 || column0 > column1; }
};

// The tiles that a range reaches: the first row and column of tiles, and how many
// follow. Columns wrap around as in RayRange.
struct RayTiles {
    int32_t row, column;
    uint32_t num_rows, num_columns;

    V3DG_HD uint32_t count() const { return num_rows * num_columns; }
};

// The directions of the rays. In view space, x points forward, y left and z up.
// Azimuths turn from x to y and are in [0, 2 pi). Elevations are measured from the xy
// plane and are in [-pi/2, pi/2]. The tables are ascending.
struct RayDirections {
    AngleTable azimuth, elevation;
    // The cosines and sines of the angles, padded with zeros to whole tiles.
    const float *azimuth_cosine, *azimuth_sine, *elevation_cosine, *elevation_sine;
    // The column and the row of the sensor's picture that each angle belongs to.
    const int32_t *column_place, *row_place;
    // Columns and rows of a tile.
    int tile_width, tile_height;

    V3DG_HD int num_columns() const { return azimuth.size; }
    V3DG_HD int num_rows() const { return elevation.size; }
    V3DG_HD int tile_columns() const { return (num_columns() + tile_width - 1) / tile_width; }
    V3DG_HD int tile_rows() const { return (num_rows() + tile_height - 1) / tile_height; }
    V3DG_HD size_t num_tiles() const { return size_t(tile_columns()) * tile_rows(); }
    V3DG_HD size_t num_rays() const { return size_t(num_columns()) * num_rows(); }

    // Returns the index of a ray in the planes of the picture.
    V3DG_HD size_t place(int row, int column) const {
        return size_t(row_place[row]) * num_columns() + column_place[column];
    }

    V3DG_HD RayRange range_of(const DirectionBox<float>& box) const {
        RayRange range{.row0 = elevation.first_from(box.elevation0),
                       .row1 = elevation.last_up_to(box.elevation1),
                       .column0 = 0,
                       .column1 = num_columns() - 1};
        if (range.row0 > range.row1 || !(box.azimuth1 - box.azimuth0 < kTurn)) return range;
        const float turns = ::floorf(box.azimuth0 / kTurn) * kTurn;
        // This subtraction rounds, so the margin is added a second time.
        const float start = box.azimuth0 - turns - kDirectionMargin;
        const float end = box.azimuth1 - turns + kDirectionMargin;
        range.column0 = azimuth.first_from(start);
        if (end < kTurn) {
            range.column1 = azimuth.last_up_to(end);
            return range;
        }
        range.column1 = num_columns() + azimuth.last_up_to(end - kTurn);
        if (range.column0 == num_columns()) {
            range.column0 = 0;
            range.column1 -= num_columns();
        }
        const int last = range.column0 + num_columns() - 1;
        if (range.column1 > last) range.column1 = last;
        return range;
    }

    V3DG_HD RayTiles tiles_of(const RayRange& range) const {
        const int columns = tile_columns();
        const int row = range.row0 / tile_height;
        const int column = range.column0 / tile_width;
        int last = range.column1 / tile_width;
        // A range that wraps around continues at the first tile, so it may contain that
        // tile twice.
        if (range.column1 >= num_columns())
            last = columns + (range.column1 - num_columns()) / tile_width;
        if (last > column + columns - 1) last = column + columns - 1;
        return {.row = row,
                .column = column,
                .num_rows = static_cast<uint32_t>(range.row1 / tile_height - row + 1),
                .num_columns = static_cast<uint32_t>(last - column + 1)};
    }
    // Returns the index of the k-th tile.
    V3DG_HD uint32_t tile(const RayTiles& tiles, uint32_t k) const {
        const auto columns = static_cast<uint32_t>(tile_columns());
        const uint32_t column = static_cast<uint32_t>(tiles.column) + k % tiles.num_columns;
        const uint32_t row = static_cast<uint32_t>(tiles.row) + k / tiles.num_columns;
        return row * columns + (column < columns ? column : column - columns);
    }
};

// A gaussian that may hit rays, as it is read for blending. It fills two cache lines.
struct alignas(64) RayRecord {
    RayShape<float> shape;
    uint32_t order;  // breaks ties of distances; ascends in the order of the draws
    float nearest;   // no ray is hit closer than this
    float color[3];
    alignas(16) RayRange range;
};
static_assert(sizeof(RayRecord) == 128, "a record fills two cache lines");

// The distances between which hits count, and the rule for ending a ray.
struct RayLimits {
    float nearest, farthest;
    float spacing;            // angle of a pixel of the filter, rad
    float min_transmittance;  // a ray ends when its transmittance falls below this
};

}  // namespace v3dg
