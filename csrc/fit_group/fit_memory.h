#pragma once

// The places of the arrays of a fit on the device: in the shared memory of blocks, or in their
// scratch. The host decides that, and this header knows nothing of CUDA.

#include <cstddef>
#include <cstdint>
#include <type_traits>

#include "frame/record.h"

namespace v3dg {
namespace cuda {

constexpr int kViewsAtOnce = 2;
// Each half-warp blends a cell. Masks have a bit for each cell of a region; a larger picture has
// several regions.
constexpr int kCell = 4, kCellPixels = kCell * kCell;
constexpr int kRegion = 32, kRegionCells = kRegion / kCell;
static_assert(kRegionCells * kRegionCells == 64 && kCellPixels == 16,
              "a mask is a word, a cell half a warp");
using CellMask = unsigned long long;
constexpr int kAtOnce = 4;  // gaussians that a half-warp blends together
constexpr int kSums = 9;    // FalloffSums and colour
constexpr int kSumStride = 12;

// The shape that a kernel is compiled for: small groups, which keep what is read repeatedly in
// shared memory, or large ones; and the number of gaussians of a list that a warp takes from pixels
// to sums at once.
template <int kThreadsOfBlock, bool kIsSmall, int kChunkSize>
struct FitShape {
    static constexpr int kThreads = kThreadsOfBlock, kWarps = kThreads / 32, kChunk = kChunkSize;
    static constexpr bool kSmall = kIsSmall;
    // Index of a gaussian in the current views.
    using Index = std::conditional_t<kSmall, uint16_t, uint32_t>;
};

// The place of an array: in the block's shared memory, or in the team's part of the scratch.
struct Place {
    size_t offset;
    bool is_shared;
};

struct FitLayout {
    // These are in shared memory for small groups, and in the scratch for large ones.
    size_t records, sorted, keys, mask, slot_first, order, lists, errors;
    size_t list_size;          // bytes of a half-warp's list
    size_t fragments, staged;  // shared
    // These are wherever there is room.
    Place value, m, v, by_view, sum, sort_keys, sums, near_slots;
    size_t far_slots, maps, exchange;  // scratch
    uint32_t num_near_slots, num_far_slots;
    size_t shared_bytes;   // bytes of a block
    size_t scratch_bytes;  // bytes of a team
};

// Returns the bytes of a warp's fragments: two floats a gaussian and pixel, in rows of 33, and four
// floats a pixel.
V3DG_HD constexpr size_t fragments_bytes(int chunk) {
    return (chunk * 33 * 2 + 32 * 4) * sizeof(float);
}

// Allocates memory. Only small groups have arrays in shared memory that large ones have in the
// scratch.
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
    // Allocates an array that a small group must have in shared memory.
    size_t hot(size_t bytes) { return is_small ? in_shared(bytes) : in_scratch(bytes); }
    // Allocates an array that a small group has in shared memory while there is room.
    Place anywhere(size_t bytes) {
        const bool fits = is_small && shared + rounded(bytes) <= shared_limit;
        return {fits ? in_shared(bytes) : in_scratch(bytes), fits};
    }
};

// The sizes that a layout follows from.
struct FitSizes {
    size_t most_gaussians, floats_per_gaussian;  // largest of a group
    int largest_picture;                         // px a side
    bool has_dssim;
    size_t num_blocks;    // blocks that fit a group together
    size_t shared_limit;  // most bytes of a block
};

// Returns the layout. Fields that only large groups have, or only small ones, are 0 for the others.
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
    // A small group's keys are no longer needed when it is in order, before it gets slots.
    l.keys = kSmall ? l.slot_first : arena.hot(places * sizeof(uint32_t));
    l.order = arena.hot(places * kIndex);
    l.list_size = Arena::rounded((padded + kAtOnce) * kIndex);
    l.lists = arena.hot(2 * kWarps * (kSmall ? 1 : num_blocks) * l.list_size);
    l.fragments = arena.in_shared(kFragments);
    const size_t errors_bytes = kViewsAtOnce * (cells + largest) * 2 * kFloat;
    l.errors = kSmall && errors_bytes <= kFragments ? l.fragments : arena.hot(errors_bytes);
    if (!kSmall) l.staged = arena.in_shared(kWarps * 2 * Shape::kChunk * sizeof(Record<float>));
    // Fragments, and the lists of small groups before them, are no longer needed when gradients are
    // written, and not yet needed when keys are sorted.
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
                  "sums take the place of the records");
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
        // The rest of the shared memory holds slots.
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
