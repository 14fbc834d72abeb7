// Casts rays on the CPU. Gaussians are projected in parallel chunks, and their records
// are sorted into tiles. The tiles are then blended in parallel.

#include "base/threads.h"
#include "rays/rays.h"

#include <omp.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <utility>

#include "base/buffer.h"
#include "base/parallel_for.h"

namespace v3dg {

namespace {

constexpr uint64_t kPieceSize = 4096;
// Each chunk counts its records per tile. These constants bound the number of chunks
// and the total number of counters, and so the memory for counting.
constexpr size_t kMostBinChunks = 64, kMostBinCounters = size_t(1) << 24;

// A part of a draw, projected by one thread.
struct Piece {
    size_t draw;
    uint64_t skip, count;
};

// Groups neighbouring pieces into chunks of about kPieceSize gaussians. A thread
// projects one chunk at a time.
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

std::vector<float> padded(Span<const double> angles, size_t tile, double (*function)(double)) {
    std::vector<float> values((angles.size + tile - 1) / tile * tile, 0.0f);
    for (size_t i = 0; i < angles.size; ++i) values[i] = static_cast<float>(function(angles[i]));
    return values;
}

AngleTable table_of(const RayGrid::Angles& angles) {
    return {.angles = angles.angles.data(),
            .first_in_bucket = angles.first_in_bucket.data(),
            .size = static_cast<int>(angles.angles.size()),
            .buckets_per_radian = angles.buckets_per_radian};
}

// Concatenates the records of all chunks, in the order of the draws.
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
void for_tiles(const RayRecord& record, const RayDirections& rays, const Body& body) {
    const RayTiles tiles = rays.tiles_of(record.range);
    for (uint32_t k = 0; k < tiles.count(); ++k) body(rays.tile(tiles, k));
}

// The records of each tile. An entry has the bits of the record's nearest distance in
// its upper half, and the index of the record in its lower half. Sorting entries as
// integers therefore sorts them by distance.
struct RayLists {
    std::vector<uint64_t> first;  // [tiles + 1]
    Buffer<uint64_t> entries;

    RayLists(const RayRecord* records, size_t size, const RayDirections& rays) {
        const size_t tiles = rays.num_tiles();
        const size_t most_chunks = std::clamp<size_t>(kMostBinCounters / tiles, 1, kMostBinChunks);
        const size_t num_chunks = std::clamp<size_t>(size / kPieceSize, 1, most_chunks);
        const auto begin = [&](size_t chunk) { return size * chunk / num_chunks; };
        std::vector<std::vector<uint64_t>> next(num_chunks);
        parallel_for(num_chunks, 1, [&](size_t chunk) {
            next[chunk].assign(tiles, 0);
            for (size_t i = begin(chunk); i < begin(chunk + 1); ++i)
                for_tiles(records[i], rays, [&](size_t tile) { ++next[chunk][tile]; });
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
                for_tiles(records[i], rays,
                          [&](size_t tile) { entries.data()[next[chunk][tile]++] = entry; });
            }
        });
    }

    Span<uint64_t> of_tile(size_t tile) const {
        return {entries.data() + first[tile], static_cast<size_t>(first[tile + 1] - first[tile])};
    }
};

}  // namespace

RayGrid::Angles::Angles(Span<const double> values, Span<const int32_t> places, size_t tile)
    : angles(values.begin(), values.end()),
      first_in_bucket(values.size + 1),
      cosine(padded(values, tile, std::cos)),
      sine(padded(values, tile, std::sin)),
      place(places.begin(), places.end()) {
    const float span = angles.back() - angles.front();
    const auto size = static_cast<float>(values.size);
    buckets_per_radian = span > 0 ? size / span : 0;
    size_t i = 0;
    for (size_t bucket = 0; bucket < first_in_bucket.size(); ++bucket) {
        const float start = angles.front() + static_cast<float>(bucket) * (span / size);
        while (i + 1 < angles.size() && angles[i] < start) ++i;
        first_in_bucket[bucket] = static_cast<int32_t>(i);
    }
}

RayGrid::RayGrid(Span<const double> azimuth, Span<const double> elevation,
                 Span<const int32_t> row_place, Span<const int32_t> column_place)
    : azimuth_(azimuth, column_place, kRayTileColumns),
      elevation_(elevation, row_place, kRayTileRows),
      directions_{.azimuth = table_of(azimuth_),
                  .elevation = table_of(elevation_),
                  .azimuth_cosine = azimuth_.cosine.data(),
                  .azimuth_sine = azimuth_.sine.data(),
                  .elevation_cosine = elevation_.cosine.data(),
                  .elevation_sine = elevation_.sine.data(),
                  .column_place = azimuth_.place.data(),
                  .row_place = elevation_.place.data(),
                  .tile_width = kRayTileColumns,
                  .tile_height = kRayTileRows} {}

void cpu::cast_rays(const std::vector<Draw<float>>& draws, const RayDirections& rays,
                    const RayLimits& limits, const RayPlanes& planes) {
    const std::vector<std::vector<Piece>> chunks = chunks_of(draws);
    std::vector<std::vector<RayRecord>> parts(chunks.size());
    parallel_for(chunks.size(), 1, [&](size_t c) {
        for (const Piece& piece : chunks[c])
            V3DG_DISPATCH_ISA(project_to_rays, draws[piece.draw], piece.skip, piece.count, rays,
                              limits, parts[c]);
    });
    size_t num_records = 0;
    const Buffer<RayRecord> records = join(parts, num_records);
    const RayLists lists(records.data(), num_records, rays);
    std::vector<RayScratch> scratch(most_threads());
    parallel_for(rays.num_tiles(), 1, [&](size_t tile) {
        const Span<uint64_t> entries = lists.of_tile(tile);
        std::sort(entries.begin(), entries.end());
        V3DG_DISPATCH_ISA(cast_tile, records.data(), entries, rays, tile, limits,
                          scratch[omp_get_thread_num()], planes);
    });
}

}  // namespace v3dg
