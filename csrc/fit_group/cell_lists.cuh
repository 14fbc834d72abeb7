#pragma once

// Lists the gaussians that reach each cell of 4 x 4 pixels. A record has a mask of its
// cells, and a gradient slot for each of them.

#include "base/scan.cuh"
#include "fit_group/depth_order.cuh"

namespace v3dg {
namespace cuda {

// Returns a mask of the cells of the region at (left, top) that the record may reach,
// row by row. The test rounds to pixel centres, because every cell in the mask needs a
// slot and a list entry.
__device__ inline CellMask cells_of(const Record<float>& r, int left, int top) {
    const PixelBox<int> box{max(r.x0 - left, 0), min(r.x1 - left, kRegion - 1), max(r.y0 - top, 0),
                            min(r.y1 - top, kRegion - 1)};
    if (!box.holds_pixels()) return 0;
    const EllipseRows<float> ellipse = ellipse_rows(r.l11, r.l12, r.l22, r.log2_opacity);
    const float u = r.u - static_cast<float>(left) - 0.5f, v = r.v - static_cast<float>(top) - 0.5f;
    CellMask reached = 0;
    for (int row = box.y0 / kCell; row <= box.y1 / kCell; ++row) {
        const float low = static_cast<float>(kCell * row) - v;
        float from, to;
        row_extent(ellipse, low, low + static_cast<float>(kCell - 1), from, to);
        const int first = max(box.x0, ceil_to_int(max_of(u + from, -1.0f)));
        const int last = min(box.x1, floor_to_int(min_of(u + to, static_cast<float>(kRegion))));
        if (first > last) continue;
        const uint32_t columns = (2u << last / kCell) - (1u << first / kCell);
        reached |= static_cast<CellMask>(columns) << (kRegionCells * row);
    }
    return reached;
}

// Sorts the records of a large group by depth, and computes their cells. Then waits for
// the team.
template <class Fit>
__device__ void arrange_by_depth(const Fit& fit, int num_views) {
    for (uint32_t r = fit.first(); r < num_views * fit.n_padded; r += fit.stride()) {
        const uint32_t j = fit.order()[r];
        const bool is_hidden = fit.keys()[j] == kHiddenKey;
        Record<float> record{};
        if (!is_hidden) fit.ranked()[r] = record = fit.records()[j];
        for (int region = 0; region < fit.num_regions(); ++region)
            fit.mask(region)[r] = is_hidden
                                      ? 0
                                      : cells_of(record, region % fit.regions_across * kRegion,
                                                 region / fit.regions_across * kRegion);
    }
    fit.sync();
}

// Assigns one slot per cell to each record, region by region. Returns the number of
// slots.
template <class Fit>
__device__ uint32_t assign_slots(const Fit& fit, int num_views) {
    const uint32_t used = num_views * fit.n_padded, count = fit.num_regions() * used;
    const auto mask_at = [&](uint32_t t) {
        return Fit::kSmall ? fit.mask(0)[t] : fit.mask(t / used)[t % used];
    };
    const uint32_t each = (count + fit.stride() - 1) / fit.stride();
    const uint32_t begin = min(count, (fit.team_rank * Fit::kThreads + threadIdx.x) * each);
    const uint32_t end = min(count, begin + each);
    uint32_t own_slots = 0;
    for (uint32_t t = begin; t < end; ++t) own_slots += __popcll(mask_at(t));
    const uint32_t upto = warp_prefix(own_slots);
    if (threadIdx.x % 32 == 31) fit.s.warp_total[threadIdx.x / 32] = upto;
    __syncthreads();
    uint32_t before = upto - own_slots, total = 0;
    for (uint32_t w = 0; w < Fit::kWarps; ++w) {
        if (w < threadIdx.x / 32) before += fit.s.warp_total[w];
        total += fit.s.warp_total[w];
    }
    if (fit.team_size > 1) {
        if (threadIdx.x == 0) fit.team.num_slots[fit.team_rank] = total;
        fit.sync();
        total = 0;
        for (unsigned rank = 0; rank < fit.team_size; ++rank) {
            if (rank < fit.team_rank) before += fit.team.num_slots[rank];
            total += fit.team.num_slots[rank];
        }
    }
    for (uint32_t t = begin; t < end; ++t) {
        fit.slot_first(Fit::kSmall ? 0 : t / used)[Fit::kSmall ? t : t % used] = before;
        before += __popcll(mask_at(t));
    }
    return total;
}

// Adds the slots of each record in some regions to its sums over earlier regions.
template <class Fit>
__device__ void sum_slots(const Fit& fit, int num_views, const float* slots, uint32_t slot_base,
                          int first_region, int last_region) {
    // A thread adds up three values of a record, which are adjacent in each slot.
    constexpr uint32_t kLoads = 4, kValues = 3, kParts = kSums / kValues;
    static_assert(kParts * kValues == kSums);
    float* sums = fit.at(fit.layout.sums);
    for (uint32_t q = fit.first(); q < num_views * fit.n_padded * kParts; q += fit.stride()) {
        const uint32_t j = q / kParts, k = (q - j * kParts) * kValues;
        float sum[kValues] = {0, 0, 0};
        if (first_region > 0)
            for (uint32_t v = 0; v < kValues; ++v) sum[v] = sums[kSumStride * j + k + v];
        for (int region = first_region; region < last_region; ++region) {
            const uint32_t count = __popcll(fit.mask(region)[j]);
            const float* slot =
                slots + kSums * static_cast<size_t>(fit.slot_first(region)[j] - slot_base) + k;
            for (uint32_t t = 0; t < count; t += kLoads, slot += kLoads * kSums) {
                float x[kLoads][kValues];
#pragma unroll
                for (uint32_t l = 0; l < kLoads; ++l)
#pragma unroll
                    for (uint32_t v = 0; v < kValues; ++v)
                        x[l][v] = t + l < count ? slot[kSums * l + v] : 0;
#pragma unroll
                for (uint32_t l = 0; l < kLoads; ++l)
#pragma unroll
                    for (uint32_t v = 0; v < kValues; ++v) sum[v] += x[l][v];
            }
        }
#pragma unroll
        for (uint32_t v = 0; v < kValues; ++v) sums[kSumStride * j + k + v] = sum[v];
    }
}

// The list of a half-warp's cell: ranks of records, nearest first. The lists of both
// half-warps have the same length. The shorter list is padded with the rank of an empty
// record; `filled` is its length without padding.
template <class Fit>
struct CellList {
    const typename Fit::Index* entry;
    uint32_t length, filled;
};

// Writes the lists of two horizontally adjacent cells in view b. Returns the list of
// this lane's cell. `cell` is the bit of the left cell in masks.
template <class Fit>
__device__ CellList<Fit> make_lists(const Fit& fit, int b, int region, int cell) {
    constexpr int kLoads = 4;
    const uint32_t lane = threadIdx.x % 32, before = (1u << lane) - 1;
    const CellMask* masks = fit.mask(region);
    uint32_t left = 0, right = 0;
    for (uint32_t first = 0; first < fit.n_padded; first += 32 * kLoads) {
        typename Fit::Index j[kLoads];
        uint32_t reached[kLoads];
#pragma unroll
        for (int q = 0; q < kLoads; ++q) {
            const uint32_t i = first + 32 * q + lane;
            reached[q] = 0;
            if (i >= fit.n_padded) continue;
            j[q] = static_cast<typename Fit::Index>(b * fit.n_padded + i);
            if (Fit::kSmall) j[q] = fit.order()[j[q]];
            reached[q] = static_cast<uint32_t>(masks[j[q]] >> cell) & 3;
        }
#pragma unroll
        for (int q = 0; q < kLoads; ++q) {
            const uint32_t in_left = __ballot_sync(kAllLanes, reached[q] & 1);
            const uint32_t in_right = __ballot_sync(kAllLanes, reached[q] & 2);
            if (reached[q] & 1) fit.list(0)[left + __popc(in_left & before)] = j[q];
            if (reached[q] & 2) fit.list(1)[right + __popc(in_right & before)] = j[q];
            left += __popc(in_left);
            right += __popc(in_right);
        }
    }
    const int half = lane / kCellPixels;
    const uint32_t length = half == 0 ? left : right;
    const uint32_t filled = (max(left, right) + kAtOnce - 1) / kAtOnce * kAtOnce;
    typename Fit::Index* const own = fit.list(half);
    for (uint32_t i = length + lane % kCellPixels; i < filled; i += kCellPixels)
        own[i] = static_cast<typename Fit::Index>(fit.nothing());
    __syncwarp();
    return {own, length, filled};
}

}  // namespace cuda
}  // namespace v3dg
