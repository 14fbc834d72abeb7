#pragma once

// The memory layout of a fit on the device. An array is either in the shared memory of
// a block, or in scratch memory. The host computes the layout, so this header does not
// use CUDA.

#include <cstddef>
#include <cstdint>
#include <type_traits>

#include "frame/record.h"

namespace v3dg {
namespace cuda {

constexpr int kViewsAtOnce = 2;
// Maximum number of gaussians in a small group. The picture of a small group is a
// single region.
constexpr uint32_t kSmallCount = 256;
// The size, px, of a cell and of a region. A half-warp blends a cell, and a CellMask
// has one bit per cell of a region. Larger pictures have several regions.
constexpr int kCell = 4, kCellPixels = kCell * kCell;
constexpr int kRegion = 32, kRegionCells = kRegion / kCell;
static_assert(kRegionCells * kRegionCells == 64 && kCellPixels == 16,
              "a CellMask has 64 bits, and a half-warp has 16 lanes");
using CellMask = unsigned long long;
constexpr int kAtOnce = 4;  // gaussians that a half-warp blends together
constexpr int kSums = 9;    // values per slot: FalloffSums and colour
constexpr int kSumStride = 12;

// The properties of a kernel that are fixed at compile time. If groups are small,
// frequently read arrays are in shared memory. `kChunkSize` is the number of gaussians
// that a warp processes between two sums over pixels.
template <int kThreadsOfBlock, bool kIsSmall, int kChunkSize>
struct FitShape {
    static constexpr int kThreads = kThreadsOfBlock, kWarps = kThreads / 32, kChunk = kChunkSize;
    static constexpr bool kSmall = kIsSmall;
    // The index of a gaussian in the current views.
    using Index = std::conditional_t<kSmall, uint16_t, uint32_t>;
};

// The location of an array, either in the block's shared memory or in the team's
// scratch memory.
struct Place {
    size_t offset;
    bool is_shared;
};

struct FitLayout {
    // Arrays that are in shared memory for small groups, and in scratch memory for
    // large groups.
    size_t records, sorted, keys, mask, slot_first, order, lists, errors;
    size_t list_size;          // bytes of a half-warp's list
    size_t fragments, staged;  // always in shared memory
    // Arrays that are in shared memory if there is room, and otherwise in scratch
    // memory.
    Place value, m, v, by_view, sum, sort_keys, sums, near_slots;
    size_t far_slots, maps, exchange;  // always in scratch memory
    uint32_t num_near_slots, num_far_slots;
    size_t shared_bytes;   // bytes per block
    size_t scratch_bytes;  // bytes per team
};

// Returns the number of bytes of a warp's fragments. There are two floats per gaussian
// and pixel, in rows of 33, and then four floats per pixel.
V3DG_HD constexpr size_t fragments_bytes(int chunk) {
    return (chunk * 33 * 2 + 32 * 4) * sizeof(float);
}

// Allocates arrays in shared memory and in scratch memory.
struct Arena {
    bool is_small;
    size_t shared_limit, shared = 0, scratch = 0;  // bytes

    static size_t rounded(size_t bytes) { return (bytes + 15) / 16 * 16; }
    size_t in_shared(size_t bytes) {
        shared += rounded(bytes);
        return shared - rounded(bytes);
    }
    size_t in_scratch(size_t bytes) {
        scratch += rounded(bytes);
        return scratch - rounded(bytes);
    }
    // Allocates shared memory for a small group, and scratch memory for a large group.
    size_t hot(size_t bytes) { return is_small ? in_shared(bytes) : in_scratch(bytes); }
    // Allocates shared memory for a small group if there is room, and otherwise scratch
    // memory.
    Place anywhere(size_t bytes) {
        const bool fits = is_small && shared + rounded(bytes) <= shared_limit;
        return {fits ? in_shared(bytes) : in_scratch(bytes), fits};
    }
};

// The sizes that determine a layout.
struct FitSizes {
    size_t most_gaussians, floats_per_gaussian;  // maxima over all groups
    int largest_picture;                         // side, px
    bool has_dssim;
    size_t num_blocks;    // blocks that fit a group together
    size_t shared_limit;  // bytes per block
};

// Returns the layout. Fields that a group of this size does not use are 0.
template <class Shape>
FitLayout layout_of(const FitSizes& sizes) {
    constexpr bool kSmall = Shape::kSmall;
    constexpr size_t kFloat = sizeof(float), kIndex = sizeof(typename Shape::Index),
                     kWarps = Shape::kWarps;
    constexpr size_t kFragments = kWarps * fragments_bytes(Shape::kChunk);
    FitLayout l{};
    Arena arena{kSmall, sizes.shared_limit};
    const size_t largest = sizes.largest_picture, num_blocks = sizes.num_blocks;
    const size_t padded = (sizes.most_gaussians + 31) / 32 * 32, places = kViewsAtOnce * padded;
    const size_t values = sizes.most_gaussians * sizes.floats_per_gaussian;
    const size_t regions_across = (largest + kRegion - 1) / kRegion;
    const size_t regions = regions_across * regions_across;
    const size_t cells_across = (largest + kCell - 1) / kCell, cells = cells_across * cells_across;
    l.records = arena.hot((places + 1) * sizeof(Record<float>));
    if (!kSmall) l.sorted = arena.hot((places + 1) * sizeof(Record<float>));
    l.mask = arena.hot(regions * places * sizeof(CellMask));
    l.slot_first = arena.hot(regions * places * sizeof(uint32_t));
    // In a small group, keys share memory with slot_first, because keys are no longer
    // needed when slots are assigned.
    l.keys = kSmall ? l.slot_first : arena.hot(places * sizeof(uint32_t));
    l.order = arena.hot(places * kIndex);
    l.list_size = Arena::rounded((padded + kAtOnce) * kIndex);
    l.lists = arena.hot(2 * kWarps * (kSmall ? 1 : num_blocks) * l.list_size);
    l.fragments = arena.in_shared(kFragments);
    const size_t errors_bytes = kViewsAtOnce * (cells + largest) * 2 * kFloat;
    l.errors = kSmall && errors_bytes <= kFragments ? l.fragments : arena.hot(errors_bytes);
    if (!kSmall) l.staged = arena.in_shared(kWarps * 2 * Shape::kChunk * sizeof(Record<float>));
    // Gradients and sort keys share memory with the fragments and, in small groups,
    // with the lists. Gradients and keys are never in use at the same time as lists or
    // fragments.
    const size_t over = kSmall ? l.lists : l.fragments;
    const auto over_fragments = [&](size_t bytes) {
        return num_blocks == 1 && bytes <= l.fragments + kFragments - over ? Place{over, true}
                                                                           : arena.anywhere(bytes);
    };
    if (kSmall && num_blocks > 1)
        l.exchange = arena.in_scratch(2 * kViewsAtOnce * values * kFloat);
    else
        l.by_view = over_fragments(kViewsAtOnce * values * kFloat);
    if (!kSmall) {
        size_t size = 32;
        while (size < sizes.most_gaussians) size *= 2;
        l.sort_keys = over_fragments(size * sizeof(unsigned long long));
    }
    static_assert(kSumStride * kFloat == sizeof(Record<float>),
                  "sums overwrite the records, so they must have the same size");
    l.sums = {l.records, kSmall};
    l.value = arena.anywhere(values * kFloat);
    l.m = arena.anywhere(values * kFloat);
    l.v = arena.anywhere(values * kFloat);
    l.sum = {arena.in_scratch(values * kFloat), false};
    // There is room for at least the slots of one region.
    l.num_far_slots = static_cast<uint32_t>(places * kRegionCells * kRegionCells);
    l.far_slots = arena.in_scratch(l.num_far_slots * kSums * kFloat);
    if (sizes.has_dssim)
        l.maps = arena.in_scratch(10 * 3 * kViewsAtOnce * largest * largest * kFloat);
    if (kSmall && arena.shared < sizes.shared_limit) {
        // Slots use the remaining shared memory.
        l.num_near_slots =
            static_cast<uint32_t>((sizes.shared_limit - arena.shared) / (kSums * kFloat));
        l.near_slots = {arena.in_shared(l.num_near_slots * kSums * kFloat), true};
    }
    l.shared_bytes = arena.shared;
    l.scratch_bytes = (arena.scratch + 127) / 128 * 128;
    return l;
}

}  // namespace cuda
}  // namespace v3dg
