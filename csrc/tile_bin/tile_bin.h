#pragma once

// The lists of records from which the tiles of a picture are blended: sorted tile by
// tile on the CPU, unsorted on CUDA.

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "base/buffer.h"
#include "base/stream.h"
#include "frame/entry.h"
#include "frame/image.h"
#include "frame/record.h"
#include "frame/tile_list.h"

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
    // Return the column and the row of a tile in the image.
    int column(size_t tile) const { return first_column + static_cast<int>(tile % columns); }
    int row(size_t tile) const { return first_row + static_cast<int>(tile / columns); }
};

// The records that touch tile t are entries offset[t] to offset[t + 1], in the order of
// the chunks.
struct TileLists {
    EntryFormat format;
    Buffer<uint64_t> offset;
    Buffer<uint64_t> entry;
    uint64_t num_entries = 0;
    // The lists of a single chunk, whose records are [first, first + count).
    struct Chunk {
        uint64_t first, count;
        uint32_t least_depth, most_depth;  // bits of the records' depths
        // Entries with the record's index in the chunk and all bits of a depth.
        Buffer<uint64_t> entry;
    };
    Buffer<uint32_t> chunk_offset;  // (chunk, tile + 1)
    std::vector<Chunk> chunk;

    void start(size_t num_chunks, const TileGrid& grid) {
        chunk_offset.reserve(num_chunks * (grid.size() + 1));
        if (chunk.size() < num_chunks) chunk.resize(num_chunks);
    }
};

// A chunk has at most this many records.
constexpr uint64_t kMostChunkRecords = uint64_t(1) << 21;

// Bins the records of one chunk, which are records[first .. first + count). It is
// fastest while they are in the cache. Chunks may be binned concurrently.
template <class T>
void bin_chunk(const Record<T>* records, uint64_t first, uint32_t count, const TileGrid& grid,
               size_t chunk, TileLists& out);

// Joins the lists of the chunks into one list per tile. Once `stop` is true, it returns
// soon and leaves the lists unfinished.
void join_chunks(size_t num_chunks, const TileGrid& grid, TileLists& out,
                 const std::atomic<bool>* stop = nullptr);

// Sorts the entries of one tile by the depths of their records; equal depths keep their
// order. `scratch` has room for as many entries.
template <class T>
void sort_tile(const Record<T>* records, EntryFormat format, uint64_t* entry, size_t count,
               uint64_t* scratch);

namespace cuda {

// The input of tile_bin(), all on the device.
struct TileBinInput {
    const ItemTiles* items;
    const FewTiles* few;  // tiles of each record, or kManyTiles if it is in `large`
    RecordPlanes records;
    const FrameImage* images;
    uint32_t num_images, num_tiles;
    Capacity capacity;
    const LargeRecord* large;
    TileCounts counts;
    // This function sets `entries` of the counters. If there was too little room for
    // the large records, these are not counted.
    FrameCounters* counters;
};

// The output lists: tile t has entries tile_first[t] to tile_first[t + 1].
struct TileBinOutput {
    unsigned long long* tile_first;  // [num_tiles + 1]
    uint32_t* image_of_tile;         // [num_tiles]
    TileEntry* entries;
};

// Returns the number of elements of TileCounts::state.
size_t tile_bin_parts(size_t num_tiles);

// Adds a frame's records to the lists of the tiles that they may touch. Work is queued
// on the stream. Throws std::runtime_error if CUDA reports an error.
void tile_bin(const TileBinInput& in, const TileBinOutput& out, Stream stream);

}  // namespace cuda

}  // namespace v3dg
