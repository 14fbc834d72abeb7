#pragma once

// Casts rays on CUDA. The items of a frame are projected to records and entries, the
// entries are sorted, and the rays of each tile are blended.

#include "base/device.h"
#include "frame/draw_list.h"
#include "project/project_cuda.h"
#include "rays/ray_entry.h"
#include "rays/rays.h"

namespace v3dg {
namespace cuda {

// A tile is blended by one warp, with one lane per ray.
constexpr int kRaysOfTile = 32;

// Entries (ray_entry.h) code distances in at least kLeastDistanceBits, and in more as
// long as no more than kSortedBits are sorted. This limits the number of tiles of all
// pictures together to kMostRayTiles.
constexpr unsigned kSortedBits = 32, kLeastDistanceBits = 8;
constexpr size_t kMostRayTiles = (size_t(1) << (64 - kRecordBits - kLeastDistanceBits)) - 1;

// The gaussians of a cast. A model is stored either in `rows` or in `coded`; its
// element in the other list is empty. A list that no model uses is null.
struct RayInput {
    const GaussianRows<const float>* rows;
    const CodedGaussians* coded;
    const Placement* placements;
    ItemList items;
    // as in ProjectInput; may be null
    const InstanceFactors* factors;
    uint32_t num_factors;
    ImageCounts* image_counts;  // [images] the kernel adds to these counts

    V3DG_HD const InstanceFactors* factors_of(const DrawItem& item) const {
        return factors + item.placement % num_factors;
    }
};

// The numbers of records and entries are packed into one integer, so that a warp
// updates both with one atomic operation. A cast has at most kMostRayGaussians
// gaussians, so the records need no more than these bits. The other 36 bits count
// entries.
constexpr unsigned long long kMostRayGaussians = kMostRecords;
struct RayListCounts {
    unsigned long long both;

    V3DG_HD unsigned long long records() const { return both & kMostRayGaussians; }
    V3DG_HD unsigned long long entries() const { return both >> kRecordBits; }
};

// The records that may hit rays, and one entry for each tile that a record reaches.
// Tiles are counted over all pictures, and the distance of an entry is a lower bound on
// the record's distances in the tile. The order in memory varies from run to run.
struct RayLists {
    RayRecord* records;
    uint64_t* entries;
    // Counters in device memory, initially 0. They also count records and entries
    // beyond the capacities, which are not stored.
    RayListCounts* counts;
    unsigned long long record_capacity, entry_capacity;
    unsigned distance_bits;
};

// Returns the number of bits of a key that are left for the distance.
unsigned distance_bits_of(size_t num_tiles);

// Writes the records and entries of all items. Does nothing if the number of items
// exceeds their capacity.
void project_to_rays(const RayInput& in, const RayDirections& rays, const RayLimits& limits,
                     const RayLists& out, cudaStream_t stream);

// Scratch memory for sorting entries.
struct RaySortBuffers {
    DeviceBuffer<uint64_t> sorted;
    DeviceBuffer<unsigned char> scratch;
    DeviceBuffer<uint32_t> first;  // [tiles + 1] first entry of each tile
    DeviceBuffer<uint32_t> order;  // [tiles] tiles, those with the longest lists first
};

// Sorts the entries, finds the first entry of each tile, and orders the tiles.
void sort_entries(const RayLists& lists, size_t num_entries, size_t num_tiles,
                  RaySortBuffers& buffers, cudaStream_t stream);

// Blends the rays of `num_images` pictures. Each plane holds the pictures one after
// another.
void cast_rays(const RayLists& lists, const RaySortBuffers& sorted, size_t num_images,
               const RayDirections& rays, const RayLimits& limits, const RayPlanes& planes,
               cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
