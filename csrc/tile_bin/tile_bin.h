#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "base/buffer.h"
#include "frame/entry.h"
#include "frame/image.h"
#include "frame/record.h"

namespace v3dg {

// The tiles of kTileSize pixels of an image that cover a window of it, row by row.
struct TileGrid {
    int first_column, first_row, columns, rows;
    explicit TileGrid(const Window& w)
        : first_column(w.x0 / kTileSize),
          first_row(w.y0 / kTileSize),
          columns((w.x1 + kTileSize - 1) / kTileSize - first_column),
          rows((w.y1 + kTileSize - 1) / kTileSize - first_row) {}
    size_t size() const { return static_cast<size_t>(columns) * rows; }
    // Column and row of a tile in the image.
    int column(size_t tile) const { return first_column + static_cast<int>(tile % columns); }
    int row(size_t tile) const { return first_row + static_cast<int>(tile / columns); }
};

// The records that touch each tile t, in the order of the chunks that they came in: entries
// offset[t] to offset[t + 1].
struct TileLists {
    EntryFormat format;
    Buffer<uint64_t> offset;
    Buffer<uint64_t> entry;
    uint64_t num_entries = 0;
    // The same of each chunk alone, whose records are [first, first + count) with depths of these
    // bits.
    struct Chunk {
        uint64_t first, count;
        uint32_t least_depth, most_depth;
        Buffer<uint64_t> entry;  // with places in the chunk and all of a depth
    };
    Buffer<uint32_t> chunk_offset;  // (chunk, tile + 1)
    std::vector<Chunk> chunk;

    void start(size_t num_chunks, const TileGrid& grid) {
        chunk_offset.reserve(num_chunks * (grid.size() + 1));
        if (chunk.size() < num_chunks) chunk.resize(num_chunks);
    }
};

// A chunk has at most so many records.
constexpr uint64_t kMostChunkRecords = uint64_t(1) << 21;

// Bins the records of one chunk, which are records[first .. first + count). Best done while they
// are in the cache. Chunks may be binned at the same time.
template <class T>
void bin_chunk(const Record<T>* records, uint64_t first, uint32_t count, const TileGrid& grid,
               size_t chunk, TileLists& out);

// Makes one list a tile of those of the chunks. Once `stop` is true, returns soon and leaves them
// unfinished.
void join_chunks(size_t num_chunks, const TileGrid& grid, TileLists& out,
                 const std::atomic<bool>* stop = nullptr);

// Sorts one tile's entries by the depths of their records; equal depths stay in their order.
// `scratch` has room for as many.
template <class T>
void sort_tile(const Record<T>* records, EntryFormat format, uint64_t* entry, size_t count,
               uint64_t* scratch);

}  // namespace v3dg
