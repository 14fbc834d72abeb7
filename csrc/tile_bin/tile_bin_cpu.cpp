#include "tile_bin/tile_bin.h"

#include <algorithm>
#include <cstring>

#include "base/parallel_for.h"
#include "base/stop.h"

// Each chunk is counted, scanned and scattered alone, and most reach few tiles; then each tile takes what is
// its own, chunk by chunk, so the order of the entries does not depend on which thread took which chunk.

namespace v3dg {

template <class T, class Visit>
static void for_each_tile(const Record<T>& r, const TileGrid& grid, const Visit& visit) {
    const int x0 = r.x0 / kTileSize, x1 = r.x1 / kTileSize, y0 = r.y0 / kTileSize, y1 = r.y1 / kTileSize;
    for (int y = y0; y <= y1; ++y)
        for (int x = x0; x <= x1; ++x)
            visit(static_cast<size_t>(y - grid.first_row) * grid.columns + (x - grid.first_column));
}

template <class T>
void bin_chunk(const Record<T>* records, uint64_t first, uint32_t count, const TileGrid& grid, size_t chunk,
               TileLists& out) {
    const size_t num_tiles = grid.size();
    // Counts, then where a tile's entries begin, then where the next one goes, which ends where the next
    // tile's begin.
    uint32_t* offset = out.chunk_offset.data() + chunk * (num_tiles + 1);
    std::memset(offset, 0, (num_tiles + 1) * sizeof *offset);
    const Record<T>* record = records + first;
    for (uint32_t i = 0; i < count; ++i) for_each_tile(record[i], grid, [&](size_t t) { ++offset[t + 1]; });
    uint32_t sum = 0;
    for (size_t t = 1; t <= num_tiles; ++t) {
        const uint32_t here = offset[t];
        offset[t] = sum;
        sum += here;
    }
    uint64_t* entry = out.chunk_entry[chunk].reserve(sum);
    for (uint32_t i = 0; i < count; ++i) {
        const float depth = static_cast<float>(record[i].depth);
        uint32_t bits;  // positive floats order as their bits do
        std::memcpy(&bits, &depth, sizeof bits);
        for_each_tile(record[i], grid,
                      [&](size_t t) { entry[offset[t + 1]++] = uint64_t(bits) << 32 | (first + i); });
    }
}

void join_chunks(size_t num_chunks, const TileGrid& grid, TileLists& out, const std::atomic<bool>* stop) {
    const size_t num_tiles = grid.size(), stride = num_tiles + 1;
    const uint32_t* from = out.chunk_offset.data();
    uint64_t* offset = out.offset.reserve(stride);
    std::memset(offset, 0, stride * sizeof *offset);
    for (size_t c = 0; c < num_chunks; ++c)
        for (size_t t = 0; t < num_tiles; ++t)
            offset[t + 1] += from[c * stride + t + 1] - from[c * stride + t];
    for (size_t t = 0; t < num_tiles; ++t) offset[t + 1] += offset[t];
    out.num_entries = offset[num_tiles];
    uint64_t* entry = out.entry.reserve(out.num_entries);
    constexpr size_t kTogether = 16;  // tiles whose offsets in a chunk share a cache line
    parallel_for((num_tiles + kTogether - 1) / kTogether, 1, [&](size_t group) {
        const size_t first = group * kTogether, last = std::min(first + kTogether, num_tiles);
        uint64_t next[kTogether];
        std::copy(offset + first, offset + last, next);
        for (size_t c = 0; c < num_chunks; ++c) {
            const uint32_t* here = from + c * stride;
            if (here[first] == here[last]) continue;
            if (is_stopped(stop)) return;
            const uint64_t* source = out.chunk_entry[c].data();
            for (size_t t = first; t < last; ++t) {
                std::copy(source + here[t], source + here[t + 1], entry + next[t - first]);
                next[t - first] += here[t + 1] - here[t];
            }
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
    // Least significant digit first over the bits in which depths differ once the least is taken away;
    // stable.
    constexpr int kMostBits = 12;
    const int most_bits = count < 1024 ? 8 : kMostBits;  // few entries for few counters
    uint64_t least = ~uint64_t(0), most = 0;
    for (size_t i = 0; i < count; ++i) {
        least = std::min(least, entry[i]);
        most = std::max(most, entry[i]);
    }
    least = least >> 32 << 32;
    int bits = 0;
    while (bits < 32 && (most - least) >> (32 + bits) != 0) ++bits;
    const int passes = (bits + most_bits - 1) / most_bits;
    uint64_t* from = entry;
    uint64_t* to = scratch;
    for (int pass = 0; pass < passes; ++pass) {
        const int digit = (bits + passes - 1) / passes, shift = 32 + pass * digit;
        const uint64_t mask = (uint64_t(1) << digit) - 1;
        uint32_t start[1u << kMostBits];
        std::fill_n(start, mask + 1, 0);
        for (size_t i = 0; i < count; ++i) ++start[(from[i] - least) >> shift & mask];
        uint32_t sum = 0;
        for (uint64_t d = 0; d <= mask; ++d) {
            const uint32_t here = start[d];
            start[d] = sum;
            sum += here;
        }
        for (size_t i = 0; i < count; ++i) to[start[(from[i] - least) >> shift & mask]++] = from[i];
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

template void bin_chunk<float>(const Record<float>*, uint64_t, uint32_t, const TileGrid&, size_t, TileLists&);
template void bin_chunk<double>(const Record<double>*, uint64_t, uint32_t, const TileGrid&, size_t,
                                TileLists&);

}  // namespace v3dg
