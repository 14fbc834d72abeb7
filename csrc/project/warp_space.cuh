#pragma once

// The shared memory of a warp that projects an item: the item's tables, and the queues.

#include "base/launch.cuh"
#include "frame/count_tile.cuh"
#include "frame/record.cuh"
#include "project/sources.cuh"

namespace v3dg {
namespace cuda {

constexpr unsigned kWarps = 8;
constexpr unsigned kQueue = 64;  // at most 31 gaussians are in the queue when 32 are
                                 // added
// At most 31 large records are in the queue when 32 are added.
constexpr unsigned kMostWaiting = 64;

// A gaussian in the queue of a warp.
struct Queued {
    float p[3];  // view space
    // Index of the gaussian in the item. In a shared item, it is 32 times that index,
    // plus the index of the placement among the sharers.
    uint32_t place;
};

template <class Model>
struct WarpSpace {
    ItemTables<Model> tables;
    alignas(16) Queued queue[kQueue];
    // The ellipses of up to 32 records. Each lane writes one; then the warp copies them
    // to global memory with coalesced stores.
    float4 ellipses[kEllipseVectors * 32];
    // The queue of large records: their pixel boxes, and their indices among the item's
    // records.
    RecordBox boxes[kMostWaiting];
    uint8_t large[kMostWaiting];
    unsigned num_large;
    WaitingTiles tiles;
};

// Copies a table to shared memory with a warp: lane i copies the i-th 32-bit word.
template <class T>
__device__ uint32_t load_word(const T& from) {
    static_assert(sizeof(T) <= 32 * sizeof(uint32_t),
                  "each lane copies at most one 32-bit word of a table");
    const unsigned lane = threadIdx.x % 32;
    return lane < sizeof(T) / sizeof(uint32_t)
               ? __ldg(reinterpret_cast<const uint32_t*>(&from) + lane)
               : 0;
}
template <class T>
__device__ void store_word(T& to, uint32_t word) {
    const unsigned lane = threadIdx.x % 32;
    if (lane < sizeof(T) / sizeof(uint32_t)) reinterpret_cast<uint32_t*>(&to)[lane] = word;
}

// Copies a table of any size with a warp.
template <class T>
__device__ void copy_table(T& to, const T& from) {
    for (unsigned k = threadIdx.x % 32; k < sizeof(T) / sizeof(uint32_t); k += 32)
        reinterpret_cast<uint32_t*>(&to)[k] = __ldg(reinterpret_cast<const uint32_t*>(&from) + k);
}

// The image and the model whose tables are in the warp's shared memory.
struct Loaded {
    uint32_t image = ~0u, model = ~0u;
};

// Stores the tables of an item in shared memory. Lane i passes the i-th 32-bit word of
// the item and of the placement. The image and the model are only loaded if they differ
// from those of the previous item.
template <class Model>
__device__ void store_tables(ItemTables<Model>& tables, uint32_t item_word, uint32_t placement_word,
                             const ProjectInput& in, const Model* models, Loaded& loaded) {
    store_word(tables.item, item_word);
    store_word(tables.placement, placement_word);
    __syncwarp();
    if (tables.placement.image != loaded.image) {
        loaded.image = tables.placement.image;
        copy_table(tables.image, in.images[loaded.image]);
        __syncwarp();
        if (threadIdx.x % 32 == 0) tables.limits = tables.image.camera.limits();
    }
    if (tables.placement.model != loaded.model) {
        loaded.model = tables.placement.model;
        store_word(tables.model, load_word(models[loaded.model]));
    }
    __syncwarp();
}

}  // namespace cuda
}  // namespace v3dg
