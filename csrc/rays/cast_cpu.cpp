// Casts rays on the CPU: gaussians are projected in parallel chunks, their records are
// sorted into tiles, and tiles are blended in parallel.

#include "base/threads.h"
#include "rays/rays.h"

#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <utility>

#include "base/buffer.h"
#include "base/clock.h"
#include "base/parallel_for.h"

namespace v3dg {

namespace {

constexpr uint64_t kPieceSize = 4096;
// The largest number of chunks whose records are counted by tile, and of counters.
constexpr size_t kMostBinChunks = 64, kMostBinCounters = size_t(1) << 24;
constexpr float kTurn = static_cast<float>(2 * kPi);

// A part of a draw.
struct Piece {
    size_t draw;
    uint64_t skip, count;
};

// Neighbouring pieces that are projected together, with about kPieceSize gaussians.
std::vector<std::vector<Piece>> chunks_of(const std::vector<Draw<float>>& draws) {
    std::vector<std::vector<Piece>> chunks;
    uint64_t room = 0;
    for (size_t d = 0; d < draws.size(); ++d)
        for (uint64_t skip = 0; skip < draws[d].count;) {
            if (room == 0) {
                chunks.emplace_back();
                room = kPieceSize;
            }
            const uint64_t count = std::min(room, draws[d].count - skip);
            chunks.back().push_back({d, skip, count});
            skip += count;
            room -= count;
        }
    return chunks;
}

std::vector<float> padded(Span<const double> angles, size_t size, double (*function)(double)) {
    std::vector<float> values(size, 0.0f);
    for (size_t i = 0; i < angles.size; ++i) values[i] = static_cast<float>(function(angles[i]));
    return values;
}

size_t whole_tiles(size_t count, size_t tile) { return (count + tile - 1) / tile * tile; }

// The records of all chunks, in the order of the draws.
Buffer<RayRecord> join(const std::vector<std::vector<RayRecord>>& parts, size_t& size) {
    std::vector<size_t> first(parts.size() + 1, 0);
    for (size_t c = 0; c < parts.size(); ++c) first[c + 1] = first[c] + parts[c].size();
    size = first.back();
    if (size > UINT32_MAX)
        throw std::length_error("gaussians: expected at most 4294967295 on rays, got more");
    Buffer<RayRecord> records(size);
    parallel_for(parts.size(), 1, [&](size_t c) {
        std::copy(parts[c].begin(), parts[c].end(), records.data() + first[c]);
    });
    return records;
}

// Calls body(tile) for every tile that a record reaches.
template <class Body>
void for_tiles(const RayRecord& record, const RayGrid& grid, const Body& body) {
    const int columns = grid.tile_columns();
    const RayGrid::Range& range = record.range;
    const int first = range.column0 / kRayTileColumns;
    int last = range.column1 / kRayTileColumns;
    // Columns behind the last go on from the first tile, which may be reached twice.
    if (range.column1 >= grid.num_columns())
        last = columns + (range.column1 - grid.num_columns()) / kRayTileColumns;
    last = std::min(last, first + columns - 1);
    for (int row = range.row0 / kRayTileRows; row <= range.row1 / kRayTileRows; ++row)
        for (int column = first; column <= last; ++column)
            body(static_cast<size_t>(row) * columns + column % columns);
}

// The records of each tile, as entries: the bits of the nearest distance, which ascend
// like it, above the index of the record.
struct RayLists {
    std::vector<uint64_t> first;  // [tiles + 1]
    Buffer<uint64_t> entries;

    RayLists(const RayRecord* records, size_t size, const RayGrid& grid) {
        const size_t tiles = grid.num_tiles();
        const size_t most_chunks = std::clamp<size_t>(kMostBinCounters / tiles, 1, kMostBinChunks);
        const size_t num_chunks = std::clamp<size_t>(size / kPieceSize, 1, most_chunks);
        const auto begin = [&](size_t chunk) { return size * chunk / num_chunks; };
        std::vector<std::vector<uint64_t>> next(num_chunks);
        parallel_for(num_chunks, 1, [&](size_t chunk) {
            next[chunk].assign(tiles, 0);
            for (size_t i = begin(chunk); i < begin(chunk + 1); ++i)
                for_tiles(records[i], grid, [&](size_t tile) { ++next[chunk][tile]; });
        });
        first.assign(tiles + 1, 0);
        for (size_t tile = 0; tile < tiles; ++tile) {
            uint64_t end = first[tile];
            for (size_t chunk = 0; chunk < num_chunks; ++chunk)
                end += std::exchange(next[chunk][tile], end);
            first[tile + 1] = end;
        }
        entries.reserve(first[tiles]);
        parallel_for(num_chunks, 1, [&](size_t chunk) {
            for (size_t i = begin(chunk); i < begin(chunk + 1); ++i) {
                uint32_t bits;
                std::memcpy(&bits, &records[i].nearest, sizeof bits);
                const uint64_t entry = uint64_t(bits) << 32 | i;
                for_tiles(records[i], grid,
                          [&](size_t tile) { entries.data()[next[chunk][tile]++] = entry; });
            }
        });
    }

    Span<uint64_t> of_tile(size_t tile) const {
        return {entries.data() + first[tile], static_cast<size_t>(first[tile + 1] - first[tile])};
    }
};

}  // namespace

AngleTable::AngleTable(Span<const double> angles)
    : angles_(angles.begin(), angles.end()), first_in_bucket_(angles.size + 1) {
    const float span = angles_.back() - angles_.front();
    buckets_per_radian_ = span > 0 ? static_cast<float>(angles.size) / span : 0;
    size_t i = 0;
    for (size_t bucket = 0; bucket < first_in_bucket_.size(); ++bucket) {
        const float start =
            angles_.front() + static_cast<float>(bucket) * (span / static_cast<float>(angles.size));
        while (i + 1 < angles_.size() && angles_[i] < start) ++i;
        first_in_bucket_[bucket] = static_cast<int32_t>(i);
    }
}

int AngleTable::first_from(float value) const {
    if (!(value > angles_.front())) return 0;
    if (value > angles_.back()) return size();
    const auto bucket = static_cast<size_t>((value - angles_.front()) * buckets_per_radian_);
    int i = first_in_bucket_[std::min(bucket, first_in_bucket_.size() - 1)];
    // Rounding may lead to a neighbouring bucket.
    while (i > 0 && angles_[i - 1] >= value) --i;
    while (angles_[i] < value) ++i;
    return i;
}

int AngleTable::last_up_to(float value) const {
    int i = first_from(value);
    while (i < size() && angles_[i] <= value) ++i;
    return i - 1;
}

RayGrid::RayGrid(Span<const double> azimuth, Span<const double> elevation)
    : azimuth_(azimuth), elevation_(elevation) {
    const size_t columns = whole_tiles(azimuth.size, kRayTileColumns);
    const size_t rows = whole_tiles(elevation.size, kRayTileRows);
    azimuth_cosine_ = padded(azimuth, columns, std::cos);
    azimuth_sine_ = padded(azimuth, columns, std::sin);
    elevation_cosine_ = padded(elevation, rows, std::cos);
    elevation_sine_ = padded(elevation, rows, std::sin);
}

RayGrid::Range RayGrid::range_of(const DirectionBox<float>& box) const {
    Range range{.row0 = elevation_.first_from(box.elevation0),
                .row1 = elevation_.last_up_to(box.elevation1),
                .column0 = 0,
                .column1 = num_columns() - 1};
    if (range.row0 > range.row1 || !(box.azimuth1 - box.azimuth0 < kTurn)) return range;
    const float turns = std::floor(box.azimuth0 / kTurn) * kTurn;
    // The subtraction rounds, so the margin is once more added to its results.
    const float start = box.azimuth0 - turns - kDirectionMargin;
    const float end = box.azimuth1 - turns + kDirectionMargin;
    range.column0 = azimuth_.first_from(start);
    range.column1 =
        end < kTurn ? azimuth_.last_up_to(end) : num_columns() + azimuth_.last_up_to(end - kTurn);
    range.column1 = std::min(range.column1, range.column0 + num_columns() - 1);
    return range;
}

RayCounts cpu::cast_rays(const std::vector<Draw<float>>& draws, const RayGrid& grid,
                         const RayLimits& limits, const RayPlanes& planes) {
    const double start = now();
    const std::vector<std::vector<Piece>> chunks = chunks_of(draws);
    std::vector<std::vector<RayRecord>> parts(chunks.size());
    parallel_for(chunks.size(), 1, [&](size_t c) {
        for (const Piece& piece : chunks[c])
            V3DG_DISPATCH_ISA(project_to_rays, draws[piece.draw], piece.skip, piece.count, grid,
                              limits, parts[c]);
    });
    size_t num_records = 0;
    const Buffer<RayRecord> records = join(parts, num_records);
    const double projected = now();
    const RayLists lists(records.data(), num_records, grid);
    const double binned = now();
    std::vector<RayScratch> scratch(most_threads());
    parallel_for(grid.num_tiles(), 1, [&](size_t tile) {
        const Span<uint64_t> entries = lists.of_tile(tile);
        std::sort(entries.begin(), entries.end());
        V3DG_DISPATCH_ISA(cast_tile, records.data(), entries, grid, tile, limits,
                          scratch[omp_get_thread_num()], planes);
    });
    return {.records = num_records,
            .entries = lists.first.back(),
            .project_seconds = projected - start,
            .bin_seconds = binned - projected,
            .blend_seconds = now() - binned};
}

}  // namespace v3dg
