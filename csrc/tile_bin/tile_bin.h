#pragma once

#include <cstddef>
#include <cstdint>

#include "base/buffer.h"
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

// Records in runs, one run a chunk of the draw list: chunk c holds records[first[c] .. first[c] + count[c]).
struct RecordChunks {
    const uint64_t* first;
    const uint32_t* count;
    size_t size;
};

// The records that touch each tile t, in the order of the chunks: entries offset[t] to offset[t + 1]. Entries
// are those of frame/record.h.
struct TileLists {
    Buffer<uint64_t> offset;
    Buffer<uint64_t> entry;
    Buffer<uint64_t> cursor;  // scratch: (chunk, tile)
    uint64_t num_entries = 0;
};

template <class T>
void tile_bin(const Record<T>* records, const RecordChunks& chunks, const TileGrid& grid, TileLists& out);

// Sorts one tile's entries by depth; equal depths stay in their order. `scratch` has room for as many.
// Double-precision records are ordered by their own depth, which float32 bits do not hold.
template <class T>
void sort_tile(const Record<T>* records, uint64_t* entry, size_t count, uint64_t* scratch);

}  // namespace v3dg
