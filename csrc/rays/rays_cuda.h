#pragma once

// Casts rays on CUDA: the interface. The items of a frame are projected to records and
// entries, entries are sorted, and the rays of each tile are blended.

#include "base/device.h"
#include "frame/draw_list.h"
#include "project/project_cuda.h"
#include "rays/rays.h"

namespace v3dg {
namespace cuda {

// A key has kKeyBits bits above the index of a record, of which distances have at least
// kLeastDistanceBits. So all pictures together have at most kMostRayTiles tiles.
constexpr unsigned kKeyBits = 32, kLeastDistanceBits = 8;
constexpr size_t kMostRayTiles = (size_t(1) << (kKeyBits - kLeastDistanceBits)) - 1;

// The gaussians of a cast. Each model is in `rows` or in `coded`, and empty in the
// other list. An unused list is null.
struct RayInput {
    const GaussianRows<const float>* rows;
    const CodedGaussians* coded;
    const Placement* placements;
    ItemList items;
    // As in ProjectInput; may be null.
    const InstanceFactors* factors;
    uint32_t num_factors;
    ImageCounts* image_counts;  // [images] counts to which the kernel adds

    V3DG_HD const InstanceFactors* factors_of(const DrawItem& item) const {
        return factors + item.placement % num_factors;
    }
};

// Numbers of records and entries in one integer, so that a warp counts both at once. A
// cast of at most kMostRayGaussians gaussians has no more records than that, which
// leaves 36 bits for the entries.
constexpr unsigned kRecordBits = 28;
constexpr unsigned long long kMostRayGaussians = (1ull << kRecordBits) - 1;
struct RayListCounts {
    unsigned long long both;

    V3DG_HD unsigned long long records() const { return both & kMostRayGaussians; }
    V3DG_HD unsigned long long entries() const { return both >> kRecordBits; }
};

// The records that reach rays, and a key for each tile that a record reaches: from the
// highest bits down the tile, counted over all pictures, the lower bound of its
// distance, rounded down, and in the lowest 32 bits the index of the record. The order
// in memory is not determined.
struct RayLists {
    RayRecord* records;
    uint64_t* entries;
    // In device memory, initially 0. Records and entries beyond a capacity are counted,
    // but not stored.
    RayListCounts* counts;
    unsigned long long record_capacity, entry_capacity;
    unsigned distance_bits;
};

// Returns the number of bits that are left for distances.
unsigned distance_bits_of(size_t num_tiles);

// Writes the records and entries of all items. Does nothing if items exceed a capacity.
void project_to_rays(const RayInput& in, const RayDirections& rays, const RayLimits& limits,
                     const RayLists& out, cudaStream_t stream);

// Memory to sort entries.
struct RaySortBuffers {
    DeviceBuffer<uint64_t> sorted;
    DeviceBuffer<unsigned char> scratch;
    DeviceBuffer<uint32_t> first;  // [tiles + 1] first entry of each tile
};

// Sorts entries, and finds the first one of each tile.
void sort_entries(const RayLists& lists, size_t num_entries, size_t num_tiles,
                  RaySortBuffers& buffers, cudaStream_t stream);

// Blends the rays of `num_images` pictures, which follow each other in the planes.
void cast_rays(const RayLists& lists, const RaySortBuffers& sorted, size_t num_images,
               const RayDirections& rays, const RayLimits& limits, const RayPlanes& planes,
               cudaStream_t stream);

}  // namespace cuda
}  // namespace v3dg
