#pragma once

// The shared memory of a warp that projects an item: the tables of the item, and the
// queues.

#include "base/launch.cuh"
#include "frame/count_tile.cuh"
#include "frame/record.cuh"
#include "project/sources.cuh"

namespace v3dg {
namespace cuda {

constexpr unsigned kWarps = 8;
constexpr unsigned kQueue = 64;        // at most 31 gaussians are queued when 32 are added
constexpr unsigned kMostWaiting = 64;  // at most 31 large records are queued when 32 are added

// A gaussian in the queue.
struct Queued {
    float p[3];  // view space
    // Index in the item; in a shared item 32 times that, plus the index of the sharer.
    uint32_t place;
};

// The shared memory of a warp.
template <class Model>
struct WarpSpace {
    ItemTables<Model> tables;
    alignas(16) Queued queue[kQueue];
    // The ellipses of records: each lane writes one, and then they are copied
    // contiguously.
    float4 ellipses[kEllipseVectors * 32];
    // The queue of the item's large records: their boxes and their indices among the
    // item's records.
    RecordBox boxes[kMostWaiting];
    uint8_t large[kMostWaiting];
    unsigned num_large;
    WaitingTiles tiles;
};

// Copies a table with a warp, one 32-bit word per lane.
template <class T>
__device__ uint32_t load_word(const T& from) {
    static_assert(sizeof(T) <= 32 * sizeof(uint32_t), "a warp copies a table");
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

// Which tables the warp has loaded.
struct Loaded {
    uint32_t image = ~0u, model = ~0u;
};

// Stores the tables of an item; each lane holds one 32-bit word of them.
template <class Model>
__device__ void store_tables(ItemTables<Model>& tables, uint32_t item_word, uint32_t placement_word,
                             const ProjectInput& in, const Model* models, Loaded& loaded) {
    store_word(tables.item, item_word);
    store_word(tables.placement, placement_word);
    __syncwarp();
    if (tables.placement.image != loaded.image) {
        loaded.image = tables.placement.image;
        store_word(tables.image, load_word(in.images[loaded.image]));
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
