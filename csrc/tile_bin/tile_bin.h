#pragma once

// Binning: makes the lists of records that the tiles of a picture blend. On the CPU,
// sort_tile() sorts a list afterwards. On CUDA, the blend stage sorts it.

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

// The tiles that cover a window of an image, row by row. Tiles are aligned to the
// image.
struct TileGrid {
    int first_column, first_row, columns, rows;
    explicit TileGrid(const Window& w)
        : first_column(w.x0 / kTileSize),
          first_row(w.y0 / kTileSize),
          columns((w.x1 + kTileSize - 1) / kTileSize - first_column),
          rows((w.y1 + kTileSize - 1) / kTileSize - first_row) {}
    size_t size() const { return static_cast<size_t>(columns) * rows; }
    // Return the column and the row of a tile in the image's grid of tiles.
    int column(size_t tile) const { return first_column + static_cast<int>(tile % columns); }
    int row(size_t tile) const { return first_row + static_cast<int>(tile / columns); }
};

// The lists of all tiles. Tile t has the entries from offset[t] to offset[t + 1],
// ordered by chunk.
struct TileLists {
    EntryFormat format;
    Buffer<uint64_t> offset;
    Buffer<uint64_t> entry;
    uint64_t num_entries = 0;
    // The list of one chunk: the entries of records [first, first + count), ordered by
    // tile.
    struct Chunk {
        uint64_t first, count;
        uint32_t least_depth, most_depth;  // range of the bits of the records' depths
        // The entries of the chunk. Each has the index of the record in the chunk, and
        // all bits of the depth.
        Buffer<uint64_t> entry;
    };
    // For each chunk, the first entry of each tile in the chunk, then the end:
    // [num_chunks][num_tiles + 1].
    Buffer<uint32_t> chunk_offset;
    std::vector<Chunk> chunk;

    void start(size_t num_chunks, const TileGrid& grid) {
        chunk_offset.reserve(num_chunks * (grid.size() + 1));
        if (chunk.size() < num_chunks) chunk.resize(num_chunks);
    }
};

// Maximum number of records in a chunk.
constexpr uint64_t kMostChunkRecords = uint64_t(1) << 21;

// The format of a chunk's entries: all bits of a depth, and the index of the record in
// the chunk.
constexpr EntryFormat kChunkFormat = EntryFormat::of(kMostChunkRecords, 0, INT32_MAX);

// The lists of all tiles of a picture that one thread draws, in kChunkFormat.
struct GrowingLists {
    class List {
      public:
        void clear() { next_ = entries_.data(); }
        V3DG_INLINE void append(uint64_t entry) {
            if (next_ == entries_.data() + entries_.capacity()) grow();
            *next_++ = entry;
        }
        uint64_t* data() const { return entries_.data(); }
        size_t size() const { return static_cast<size_t>(next_ - entries_.data()); }

      private:
        void grow();

        Buffer<uint64_t> entries_;
        uint64_t* next_ = nullptr;
    };
    std::vector<List> list;

    void start(const TileGrid& grid) {
        if (list.size() < grid.size()) list.resize(grid.size());
        for (List& tile : list) tile.clear();
    }
};

// Bins the records of one chunk, records[first] to records[first + count]. This is
// fastest while the records are in the cache. Chunks may be binned concurrently.
template <class T>
void bin_chunk(const Record<T>* records, uint64_t first, uint32_t count, const TileGrid& grid,
               size_t chunk, TileLists& out);

// Appends records [first, first + count) to the lists of their tiles. Precondition:
// `first` + `count` is at most kMostChunkRecords.
template <class T>
void append_records(const Record<T>* records, uint32_t first, uint32_t count, const TileGrid& grid,
                    GrowingLists& out);

// Joins the lists of all chunks to one list per tile. If `stop` becomes true, returns
// soon, with incomplete lists.
void join_chunks(size_t num_chunks, const TileGrid& grid, TileLists& out,
                 const std::atomic<bool>* stop = nullptr);

// Sorts the entries of one tile by the depths of their records. The sort is stable.
// `scratch` must have room for `count` entries.
template <class T>
void sort_tile(const Record<T>* records, EntryFormat format, uint64_t* entry, size_t count,
               uint64_t* scratch);

namespace cuda {

// The input of tile_bin(), in device memory.
struct TileBinInput {
    const ItemTiles* items;
    // The tiles of each record, or kManyTiles for records that are in `large`.
    const FewTiles* few;
    RecordPlanes records;
    const FrameImage* images;
    uint32_t num_images, num_tiles;
    Capacity capacity;
    const LargeRecord* large;
    TileCounts counts;
    // This function sets counters->entries. That count does not include large records
    // beyond the capacity.
    FrameCounters* counters;
};

// The output of tile_bin(). Tile t has the entries from tile_first[t] to tile_first[t +
// 1].
struct TileBinOutput {
    unsigned long long* tile_first;  // [num_tiles + 1]
    uint32_t* image_of_tile;         // [num_tiles] index of the image of each tile
    TileEntry* entries;
};

// Returns the required number of elements of TileCounts::state.
size_t tile_bin_parts(size_t num_tiles);

// Enqueues the binning of a frame: adds each record to the lists of the tiles that it
// may touch. Throws std::runtime_error if CUDA reports an error.
void tile_bin(const TileBinInput& in, const TileBinOutput& out, Stream stream);

}  // namespace cuda

}  // namespace v3dg
