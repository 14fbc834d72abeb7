#include "tile_bin/tile_bin.h"

#include <algorithm>
#include <cstring>

#include "base/parallel_for.h"

// Count, scan, scatter. A chunk counts into a row of its own, so the order of the entries does not depend on
// which thread took which chunk.

namespace v3dg {

template <class T, class Visit>
static void for_each_tile(const Record<T>& r, const TileGrid& grid, const Visit& visit) {
    const int x0 = r.x0 / kTileSize, x1 = r.x1 / kTileSize, y0 = r.y0 / kTileSize, y1 = r.y1 / kTileSize;
    for (int y = y0; y <= y1; ++y)
        for (int x = x0; x <= x1; ++x)
            visit(static_cast<size_t>(y - grid.first_row) * grid.columns + (x - grid.first_column));
}

template <class T>
void tile_bin(const Record<T>* records, const RecordChunks& chunks, const TileGrid& grid, TileLists& out) {
    const size_t num_tiles = grid.size();
    uint64_t* cursor = out.cursor.reserve(num_tiles * chunks.size);
    uint64_t* offset = out.offset.reserve(num_tiles + 1);
    parallel_for(chunks.size, 1, [&](size_t c) {
        uint64_t* row = cursor + c * num_tiles;
        std::memset(row, 0, num_tiles * sizeof *row);
        const Record<T>* record = records + chunks.first[c];
        for (uint32_t i = 0; i < chunks.count[c]; ++i)
            for_each_tile(record[i], grid, [&](size_t t) { ++row[t]; });
    });
    std::memset(offset, 0, (num_tiles + 1) * sizeof *offset);
    for (size_t c = 0; c < chunks.size; ++c)
        for (size_t t = 0; t < num_tiles; ++t) {
            const uint64_t count = cursor[c * num_tiles + t];
            cursor[c * num_tiles + t] = offset[t + 1];  // entries of earlier chunks in this tile
            offset[t + 1] += count;
        }
    for (size_t t = 0; t < num_tiles; ++t) offset[t + 1] += offset[t];
    out.num_entries = offset[num_tiles];
    uint64_t* entry = out.entry.reserve(out.num_entries);
    parallel_for(chunks.size, 1, [&](size_t c) {
        uint64_t* row = cursor + c * num_tiles;
        for (size_t t = 0; t < num_tiles; ++t) row[t] += offset[t];
        for (uint32_t i = 0; i < chunks.count[c]; ++i) {
            const uint64_t place = chunks.first[c] + i;
            const float depth = static_cast<float>(records[place].depth);
            uint32_t bits;  // positive floats order as their bits do
            std::memcpy(&bits, &depth, sizeof bits);
            for_each_tile(records[place], grid,
                          [&](size_t t) { entry[row[t]++] = uint64_t(bits) << 32 | place; });
        }
    });
}

template <>
void sort_tile<float>(const Record<float>*, uint64_t* entry, size_t count, uint64_t* scratch) {
    constexpr size_t kSmall = 256;
    if (count <= kSmall) {
        constexpr uint64_t kLow = UINT32_MAX;
        for (size_t i = 0; i < count; ++i) {
            scratch[i] = entry[i] & kLow;
            entry[i] = (entry[i] & ~kLow) | i;
        }
        std::sort(entry, entry + count);
        for (size_t i = 0; i < count; ++i) entry[i] = (entry[i] & ~kLow) | scratch[entry[i] & kLow];
        return;
    }
    // Least significant digit first over the depth bits that differ; stable.
    constexpr int kDigit = 11;
    uint64_t any = 0, all = ~uint64_t(0);
    for (size_t i = 0; i < count; ++i) {
        any |= entry[i];
        all &= entry[i];
    }
    const uint64_t differ = (any ^ all) >> 32;
    uint64_t* from = entry;
    uint64_t* to = scratch;
    for (int shift = 32; shift < 64; shift += kDigit) {
        constexpr uint64_t kMask = (1u << kDigit) - 1;
        if ((differ >> (shift - 32) & kMask) == 0) continue;
        uint32_t start[1u << kDigit] = {};
        for (size_t i = 0; i < count; ++i) ++start[from[i] >> shift & kMask];
        uint32_t sum = 0;
        for (uint32_t& s : start) {
            const uint32_t here = s;
            s = sum;
            sum += here;
        }
        for (size_t i = 0; i < count; ++i) to[start[from[i] >> shift & kMask]++] = from[i];
        std::swap(from, to);
    }
    if (from != entry) std::memcpy(entry, from, count * sizeof *entry);
}

template <>
void sort_tile<double>(const Record<double>* records, uint64_t* entry, size_t count, uint64_t*) {
    std::stable_sort(entry, entry + count, [&](uint64_t a, uint64_t b) {
        return records[record_of(a)].depth < records[record_of(b)].depth;
    });
}

template void tile_bin<float>(const Record<float>*, const RecordChunks&, const TileGrid&, TileLists&);
template void tile_bin<double>(const Record<double>*, const RecordChunks&, const TileGrid&, TileLists&);

}  // namespace v3dg
