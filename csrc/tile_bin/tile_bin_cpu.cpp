// Binning on the CPU. For each chunk, entries are counted, scanned and scattered; most
// chunks only reach a few tiles. Then each tile collects its entries chunk by chunk, so
// that their order does not depend on which thread processes which chunk.

#include "tile_bin/tile_bin.h"

#include <algorithm>
#include <bit>
#include <cstring>

#include "base/parallel_for.h"
#include "base/stop.h"

namespace v3dg {

// Calls visit(tile, box in the tile) for the tiles that a record's box touches. Most
// boxes touch one tile.
template <class T, class Visit>
static V3DG_INLINE void for_each_tile(const Record<T>& r, const TileGrid& grid,
                                      const Visit& visit) {
    const int x0 = r.x0 / kTileSize, x1 = r.x1 / kTileSize, y0 = r.y0 / kTileSize,
              y1 = r.y1 / kTileSize;
    const uint32_t left = r.x0 / kBlockSize % kTileBlocks,
                   right = r.x1 / kBlockSize % kTileBlocks << 3;
    const uint32_t top = r.y0 / kBlockSize % kTileBlocks << 6,
                   bottom = r.y1 / kBlockSize % kTileBlocks << 9;
    size_t row = static_cast<size_t>(y0 - grid.first_row) * grid.columns - grid.first_column;
    if (x0 == x1 && y0 == y1) return visit(row + x0, left | right | top | bottom);
    constexpr uint32_t kLast = kTileBlocks - 1;
    for (int y = y0; y <= y1; ++y, row += grid.columns) {
        const uint32_t rows = (y == y0 ? top : 0) | (y == y1 ? bottom : kLast << 9);
        for (int x = x0; x <= x1; ++x)
            visit(row + x, rows | (x == x0 ? left : 0) | (x == x1 ? right : kLast << 3));
    }
}

template <class T>
void bin_chunk(const Record<T>* records, uint64_t first, uint32_t count, const TileGrid& grid,
               size_t chunk, TileLists& out) {
    const size_t num_tiles = grid.size();
    // offset[t + 1] is first the number of entries of tile t, then the index of its
    // first entry, then the index of its next free entry. At the end, it is therefore
    // the first entry of tile t + 1.
    uint32_t* offset = out.chunk_offset.data() + chunk * (num_tiles + 1);
    std::memset(offset, 0, (num_tiles + 1) * sizeof *offset);
    const Record<T>* record = records + first;
    for (uint32_t i = 0; i < count; ++i)
        for_each_tile(record[i], grid, [&](size_t t, uint32_t) { ++offset[t + 1]; });
    uint32_t sum = 0;
    for (size_t t = 1; t <= num_tiles; ++t) {
        const uint32_t tile_count = offset[t];
        offset[t] = sum;
        sum += tile_count;
    }
    uint64_t* entry = out.chunk[chunk].entry.reserve(sum);
    uint32_t least = UINT32_MAX, most = 0;
    for (uint32_t i = 0; i < count; ++i) {
        const Record<T>& r = record[i];
        const uint32_t depth = depth_bits_of(static_cast<float>(r.depth));
        least = std::min(least, depth);
        most = std::max(most, depth);
        const uint64_t whole = kChunkFormat.entry(depth, i, 0);
        for_each_tile(r, grid,
                      [&](size_t t, uint32_t box) { entry[offset[t + 1]++] = whole | box; });
    }
    out.chunk[chunk].first = first;
    out.chunk[chunk].count = count;
    out.chunk[chunk].least_depth = least;
    out.chunk[chunk].most_depth = most;
}

void GrowingLists::List::grow() {
    constexpr size_t kLeastCapacity = 512;
    const size_t used = size();
    Buffer<uint64_t> larger(std::max(kLeastCapacity, 2 * used));
    std::copy(entries_.data(), next_, larger.data());
    entries_ = std::move(larger);
    next_ = entries_.data() + used;
}

template <class T>
void append_records(const Record<T>* records, uint32_t first, uint32_t count, const TileGrid& grid,
                    GrowingLists& out) {
    for (uint32_t i = first; i < first + count; ++i) {
        const uint32_t depth = depth_bits_of(static_cast<float>(records[i].depth));
        const uint64_t whole = kChunkFormat.entry(depth, i, 0);
        for_each_tile(records[i], grid,
                      [&](size_t t, uint32_t box) { out.list[t].append(whole | box); });
    }
}

// Returns the format for the entries of all these chunks.
static EntryFormat format_of(const TileLists::Chunk* chunk, size_t num_chunks) {
    uint64_t end = 0;
    uint32_t least = UINT32_MAX, most = 0;
    for (size_t c = 0; c < num_chunks; ++c) {
        if (chunk[c].count == 0) continue;
        end = std::max(end, chunk[c].first + chunk[c].count);
        least = std::min(least, chunk[c].least_depth);
        most = std::max(most, chunk[c].most_depth);
    }
    return EntryFormat::of(end, std::min(least, most), most);
}

void join_chunks(size_t num_chunks, const TileGrid& grid, TileLists& out,
                 const std::atomic<bool>* stop) {
    const size_t num_tiles = grid.size(), stride = num_tiles + 1;
    const uint32_t* from = out.chunk_offset.data();
    uint64_t* offset = out.offset.reserve(stride);
    std::memset(offset, 0, stride * sizeof *offset);
    for (size_t c = 0; c < num_chunks; ++c)
        for (size_t t = 0; t < num_tiles; ++t)
            offset[t + 1] += from[c * stride + t + 1] - from[c * stride + t];
    for (size_t t = 0; t < num_tiles; ++t) offset[t + 1] += offset[t];
    out.num_entries = offset[num_tiles];
    const EntryFormat format = out.format = format_of(out.chunk.data(), num_chunks);
    uint64_t* entry = out.entry.reserve(out.num_entries);
    // The offsets of 16 tiles of a chunk fill one cache line.
    constexpr size_t kTogether = 16;
    parallel_for((num_tiles + kTogether - 1) / kTogether, 1, [&](size_t group) {
        const size_t first = group * kTogether, last = std::min(first + kTogether, num_tiles);
        uint64_t next[kTogether];
        std::copy(offset + first, offset + last, next);
        for (size_t c = 0; c < num_chunks; ++c) {
            const uint32_t* here = from + c * stride;
            if (here[first] == here[last]) continue;
            if (is_stopped(stop)) return;
            const uint64_t* source = out.chunk[c].entry.data();
            constexpr uint64_t kLow = (uint64_t(1) << kChunkFormat.depth_shift) - 1;
            const uint64_t first_record = out.chunk[c].first;
            for (size_t t = first; t < last; ++t) {
                uint64_t* to = entry + next[t - first];
                for (uint32_t i = here[t]; i < here[t + 1]; ++i)
                    *to++ =
                        format.entry(static_cast<uint32_t>(source[i] >> kChunkFormat.depth_shift),
                                     first_record, 0) +
                        (source[i] & kLow);
                next[t - first] += here[t + 1] - here[t];
            }
        }
    });
}

constexpr int kMostDigitBits = 12;

// Returns the number of bits of a digit for sorting `count` entries. Fewer entries need
// fewer counters.
static int digit_bits_of(size_t count) {
    if (count < 1024) return 8;
    if (count < 8192) return 10;
    return count < 32768 ? 11 : kMostDigitBits;
}

static void counts_to_starts(uint32_t* counts, size_t size) {
    uint32_t sum = 0;
    for (size_t d = 0; d < size; ++d) {
        const uint32_t digit_count = counts[d];
        counts[d] = sum;
        sum += digit_count;
    }
}

// Sorts a few entries by their depth bits. The sort is stable.
static void insert_by_bits(int depth_shift, uint64_t* entry, size_t count) {
    for (size_t i = 1; i < count; ++i) {
        const uint64_t moved = entry[i];
        size_t k = i;
        for (; k > 0 && entry[k - 1] >> depth_shift > moved >> depth_shift; --k)
            entry[k] = entry[k - 1];
        entry[k] = moved;
    }
}

// Sorts entries by their depth bits. The sort is stable.
static void sort_by_bits(int depth_shift, uint64_t* entry, size_t count, uint64_t* scratch) {
    constexpr size_t kFew = 16, kSmall = 256;
    if (count <= kFew) return insert_by_bits(depth_shift, entry, count);
    if (count <= kSmall) {
        const uint64_t low = (uint64_t(1) << depth_shift) - 1;
        for (size_t i = 0; i < count; ++i) {
            scratch[i] = entry[i] & low;
            entry[i] = (entry[i] & ~low) | i;
        }
        std::sort(entry, entry + count);
        for (size_t i = 0; i < count; ++i) entry[i] = (entry[i] & ~low) | scratch[entry[i] & low];
        return;
    }
    uint64_t least = ~uint64_t(0), most = 0;
    for (size_t i = 0; i < count; ++i) {
        least = std::min(least, entry[i]);
        most = std::max(most, entry[i]);
    }
    least = least >> depth_shift << depth_shift;
    const int bits = static_cast<int>(std::bit_width((most - least) >> depth_shift));
    if (bits == 0) return;
    // A radix sort with two digits. They contain only bits that still differ after the
    // smallest depth is subtracted. If more bits differ, only a few neighbours are out
    // of order afterwards.
    const int sorted_bits = std::min(bits, 2 * digit_bits_of(count));
    const int key_shift = depth_shift + bits - sorted_bits;
    const int low_bits = sorted_bits / 2;
    const uint64_t low_mask = (uint64_t(1) << low_bits) - 1;
    uint32_t low_start[1u << kMostDigitBits], high_start[1u << kMostDigitBits];
    std::fill_n(low_start, low_mask + 1, 0);
    std::fill_n(high_start, uint64_t(1) << (sorted_bits - low_bits), 0);
    for (size_t i = 0; i < count; ++i) {
        const uint64_t key = (entry[i] - least) >> key_shift;
        ++low_start[key & low_mask];
        ++high_start[key >> low_bits];
    }
    counts_to_starts(low_start, low_mask + 1);
    counts_to_starts(high_start, uint64_t(1) << (sorted_bits - low_bits));
    for (size_t i = 0; i < count; ++i)
        scratch[low_start[(entry[i] - least) >> key_shift & low_mask]++] = entry[i];
    for (size_t i = 0; i < count; ++i)
        entry[high_start[(scratch[i] - least) >> key_shift >> low_bits]++] = scratch[i];
    if (sorted_bits == bits) return;
    for (size_t i = 1; i < count; ++i) {
        if (entry[i - 1] >> depth_shift <= entry[i] >> depth_shift) continue;
        const uint64_t key = (entry[i] - least) >> key_shift;
        const auto has_key = [&](uint64_t e) { return (e - least) >> key_shift == key; };
        size_t first = i - 1, last = i + 1;
        while (first > 0 && has_key(entry[first - 1])) --first;
        while (last < count && has_key(entry[last])) ++last;
        sort_by_bits(depth_shift, entry + first, last - first, scratch);
        i = last - 1;
    }
}

// Sorts entries by the depths of their records. The sort is stable.
template <class T>
static void sort_by_records(const Record<T>* records, EntryFormat format, uint64_t* first,
                            uint64_t* last) {
    std::stable_sort(first, last, [&](uint64_t a, uint64_t b) {
        return records[format.record_of(a)].depth < records[format.record_of(b)].depth;
    });
}

template <>
void sort_tile<float>(const Record<float>* records, EntryFormat format, uint64_t* entry,
                      size_t count, uint64_t* scratch) {
    const int depth_shift = format.depth_shift;
    sort_by_bits(depth_shift, entry, count, scratch);
    if (format.dropped_bits == 0) return;
    for (size_t i = 0; i < count;) {
        const uint64_t depth = entry[i] >> depth_shift;
        const size_t first = i++;
        while (i < count && entry[i] >> depth_shift == depth) ++i;
        if (i - first > 1) sort_by_records(records, format, entry + first, entry + i);
    }
}

// Compare the records, because an entry cannot hold all bits of a double.
template <>
void sort_tile<double>(const Record<double>* records, EntryFormat format, uint64_t* entry,
                       size_t count, uint64_t*) {
    sort_by_records(records, format, entry, entry + count);
}

template void bin_chunk<float>(const Record<float>*, uint64_t, uint32_t, const TileGrid&, size_t,
                               TileLists&);
template void bin_chunk<double>(const Record<double>*, uint64_t, uint32_t, const TileGrid&, size_t,
                                TileLists&);
template void append_records<float>(const Record<float>*, uint32_t, uint32_t, const TileGrid&,
                                    GrowingLists&);
template void append_records<double>(const Record<double>*, uint32_t, uint32_t, const TileGrid&,
                                     GrowingLists&);

}  // namespace v3dg
