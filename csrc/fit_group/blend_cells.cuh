#pragma once

// Blends cells of 4 x 4 pixels with half-warps. To compute gradients, it visits the
// same gaussians again. The gradient of a gaussian is summed over the pixels of each
// cell, and stored in a slot.

#include "fit_group/cell_lists.cuh"
#include "frame/record.cuh"
#include "rasterize/rasterize_math.h"

namespace v3dg {
namespace cuda {

enum class Pass { measure, draw, train };

// A lane's pixel, in the cell of its half-warp.
struct CellPixel {
    int x, y;
    float center_x, center_y;
    bool inside;
};

template <class Fit>
__device__ CellPixel pixel_at(const Fit& fit, int cell_x, int cell_y) {
    const int lane = threadIdx.x % kCellPixels;
    const int x = cell_x * kCell + lane % kCell, y = cell_y * kCell + lane / kCell;
    return {x, y, static_cast<float>(x) + 0.5f, static_cast<float>(y) + 0.5f,
            x < fit.job.size && y < fit.job.size};
}

// List entries that are loaded with one instruction.
template <class Index>
struct alignas(kAtOnce * sizeof(Index)) CellEntries {
    Index record[kAtOnce];
};

// Copies the records of entries [begin, end) of both half-warps' lists to shared
// memory. Does nothing for small groups, whose records are always in shared memory.
template <class Fit>
__device__ void stage_records(const Fit& fit, uint32_t begin, uint32_t end) {
    if (Fit::kSmall) return;
    __syncwarp();
    for (uint32_t i = threadIdx.x % 32; i < 2 * Fit::kChunk; i += 32) {
        const uint32_t entry = begin + i % Fit::kChunk;
        if (entry >= end) continue;
        const auto* from =
            reinterpret_cast<const float4*>(fit.ranked() + fit.list(i / Fit::kChunk)[entry]);
        auto* to = reinterpret_cast<float4*>(fit.staged() + i);
        for (int k = 0; k < kRecordVectors; ++k) to[k] = from[k];
    }
    __syncwarp();
}

// kAtOnce records of a half-warp's list, from entry i on. `begin` is the first entry of
// the current chunk.
struct CellRecords {
    const Record<float>* record[kAtOnce];
};

template <class Fit>
__device__ CellRecords records_at(const Fit& fit, const CellList<Fit>& list, uint32_t i,
                                  uint32_t begin) {
    CellRecords out;
    if (Fit::kSmall) {
        using Entries = CellEntries<typename Fit::Index>;
        const Entries entries = *reinterpret_cast<const Entries*>(list.entry + i);
#pragma unroll
        for (int q = 0; q < kAtOnce; ++q) out.record[q] = fit.ranked() + entries.record[q];
    } else {
        const Record<float>* first =
            fit.staged() + threadIdx.x % 32 / kCellPixels * Fit::kChunk + (i - begin);
#pragma unroll
        for (int q = 0; q < kAtOnce; ++q) out.record[q] = first + q;
    }
    return out;
}

// Sums a value over the pixels of the lane's cell. Every lane gets the sum.
__device__ inline float cell_sum(float x) {
#pragma unroll
    for (int offset = kCellPixels / 2; offset > 0; offset /= 2)
        x += __shfl_xor_sync(kAllLanes, x, offset);
    return x;
}

// The contributions of kAtOnce gaussians to a pixel, in blending order.
struct Blended {
    float alpha[kAtOnce], before[kAtOnce], weight[kAtOnce];
    float3 color[kAtOnce];
};

__device__ inline Blended blend_records(const CellPixel& p, const CellRecords& records,
                                        float& transmittance) {
    Blended out;
#pragma unroll
    for (int q = 0; q < kAtOnce; ++q) {
        // Read the record as vectors (frame/record.cuh). If the code copied it first,
        // nvcc would round the falloff differently.
        const Record<float>& r = *records.record[q];
        const float4 a = *reinterpret_cast<const float4*>(&r.u);
        const float4 b = *reinterpret_cast<const float4*>(&r.l22);
        out.alpha[q] = alpha_of(falloff_at(p.center_x, p.center_y, a.x, a.y, a.z, a.w, b.x, b.y));
        out.color[q] = make_float3(b.z, b.w, r.color[2]);
    }
    blend_weights(out.alpha, transmittance, out.before, out.weight);
    return out;
}

// The outputs of a pass. Each pass uses only some of them.
struct BlendTargets {
    float* slots;          // used by Pass::train
    uint32_t slot_base;    // index of the first slot in `slots`
    const float* d_dssim;  // used by Pass::train; may be null
    float* picture;        // used by Pass::draw
    float2* errors;        // used by Pass::measure
};

// Number of lanes that sum the fragments of one gaussian. It is 2 if a chunk has fewer
// gaussians than a half-warp has lanes, and otherwise 1.
template <class Fit>
constexpr int kLanesOfSum = kCellPixels / (Fit::kChunk < kCellPixels ? Fit::kChunk : kCellPixels);

// Computes the gradient of record r, which is gaussian `i` of the chunk, summed over
// the half-warp's cell. All lanes must call it; lanes without a gaussian pass a null
// `slot`. The code does not use RowSums, because nvcc would round those sums
// differently, which would change the bits of bundles.
template <class Fit>
__device__ void add_up(const Fit& fit, const CellPixel& p, uint32_t i, const Record<float>& r,
                       float* slot) {
    constexpr int kLanes = kLanesOfSum<Fit>, kRows = kCell / kLanes;
    const float4 e = *reinterpret_cast<const float4*>(&r.u);
    const float l22 = r.l22;
    const uint32_t half = threadIdx.x % 32 / kCellPixels;
    const int part = threadIdx.x % kCellPixels / (kCellPixels / kLanes), first_row = part * kRows;
    const float2* shares = fit.fragments() + 33 * i + half * kCellPixels + first_row * kCell;
    const float4* d_colors = fit.d_pixels() + half * kCellPixels + first_row * kCell;
    const float left = static_cast<float>(p.x / kCell * kCell) + 0.5f,
                top = static_cast<float>(p.y / kCell * kCell + first_row) + 0.5f;
    FalloffSums<float> sums{};
    float color[3] = {0, 0, 0};
#pragma unroll
    for (int y = 0; y < kRows; ++y) {
        float exponent = 0, t1 = 0, t1_dx = 0;
        Falloff<float> f;
#pragma unroll
        for (int x = 0; x < kCell; ++x) {
            const float2 share = shares[y * kCell + x];
            const float4 d_color = d_colors[y * kCell + x];
            f = falloff_at(left + x, top + y, e.x, e.y, e.z, e.w, l22, 0.0f);
            const float d_t1 = share.x * f.t1;
            exponent += share.x;
            t1 += d_t1;
            t1_dx += d_t1 * f.dx;
            color[0] += share.y * d_color.x;
            color[1] += share.y * d_color.y;
            color[2] += share.y * d_color.z;
        }
        sums.exponent += exponent;
        sums.t1 -= 2 * t1;
        sums.t1_dx -= 2 * t1_dx;
        sums.t1_dy -= 2 * t1 * f.dy;
        sums.t2 -= 2 * f.t2 * exponent;
        sums.t2_dy -= 2 * f.t2 * exponent * f.dy;
    }
    float all[kSums] = {sums.exponent, sums.t1,  sums.t2,  sums.t1_dx, sums.t1_dy,
                        sums.t2_dy,    color[0], color[1], color[2]};
    if (kLanes == 2)
        for (float& sum : all) sum += __shfl_xor_sync(kAllLanes, sum, kCellPixels / 2);
    if (slot == nullptr) return;
#pragma unroll
    for (int k = 0; k < kSums; ++k)
        if (kLanes == 1 || (k < 5) == (part == 0)) slot[k] = all[k];
}

// Blends two horizontally adjacent cells in view b. `unit` is the index of the pair of
// cells. All lanes of the warp must call it.
template <Pass kPass, class Fit>
__device__ void blend_cells(const Fit& fit, const FitCameras& cameras, int b, int pair_x,
                            int cell_y, uint32_t unit, const BlendTargets& targets) {
    const uint32_t lane = threadIdx.x % 32;
    const CellPixel p = pixel_at(fit, 2 * pair_x + lane / kCellPixels, cell_y);
    const int region = cell_y / kRegionCells * fit.regions_across + 2 * pair_x / kRegionCells;
    const int left_cell = cell_y % kRegionCells * kRegionCells + 2 * pair_x % kRegionCells;
    const int cell = left_cell + lane / kCellPixels;
    const size_t num_pixels = static_cast<size_t>(fit.job.size) * fit.job.size;
    const size_t pixel = static_cast<size_t>(p.y) * fit.job.size + p.x;
    float4 target = make_float4(0, 0, 0, 0);
    if (kPass != Pass::draw && p.inside) target = cameras.target[b][pixel];
    const CellList<Fit> list = make_lists(fit, b, region, left_cell);
    if (kPass == Pass::train && list.filled == 0) return;

    float color[3] = {0, 0, 0}, transmittance = p.inside ? 1 : -1;
    for (uint32_t begin = 0; begin < list.filled && __any_sync(kAllLanes, transmittance > 0);
         begin += Fit::kChunk) {
        stage_records(fit, begin, list.filled);
        const uint32_t end = min(list.filled, begin + Fit::kChunk);
        for (uint32_t i = begin; i < end; i += kAtOnce) {
            const Blended blended =
                blend_records(p, records_at(fit, list, i, begin), transmittance);
#pragma unroll
            for (int q = 0; q < kAtOnce; ++q) {
                color[0] += blended.weight[q] * blended.color[q].x;
                color[1] += blended.weight[q] * blended.color[q].y;
                color[2] += blended.weight[q] * blended.color[q].z;
            }
        }
    }
    if (kPass == Pass::draw) {
        if (p.inside)
            for (int c = 0; c < 3; ++c)
                targets.picture[(3 * b + c) * num_pixels + pixel] = color[c];
        return;
    }
    const float difference[4] = {color[0] - target.x, color[1] - target.y, color[2] - target.z,
                                 1 - fabsf(transmittance) - target.w};
    if (kPass == Pass::measure) {
        float in_color = 0, in_alpha = 0;
        if (p.inside) {
            in_color = fabsf(difference[0]) + fabsf(difference[1]) + fabsf(difference[2]);
            in_alpha = fabsf(difference[3]);
        }
        in_color = warp_sum(in_color);
        in_alpha = warp_sum(in_alpha);
        if (lane == 0) targets.errors[unit] = make_float2(in_color, in_alpha);
        return;
    }

    const LossWeights& loss = fit.in.config.loss;
    const float pixels = static_cast<float>(num_pixels);
    const float weights[4] = {loss.l1 / (3 * pixels), loss.l1 / (3 * pixels),
                              loss.l1 / (3 * pixels), loss.alpha / pixels};
    float of_cell[4] = {0, 0, 0, 0};
    if (loss.cells > 0) {
        // Pixels outside the picture have no difference.
        for (int k = 0; k < 4; ++k)
            of_cell[k] = cell_slope(loss, cell_sum(difference[k]), weights[k]);
    }
    float d[4] = {0, 0, 0, 0};
    if (p.inside) {
        for (int k = 0; k < 4; ++k) d[k] = l1_vjp(difference[k], weights[k]) + of_cell[k];
        if (targets.d_dssim != nullptr)
            for (int c = 0; c < 3; ++c) d[c] += targets.d_dssim[(3 * b + c) * num_pixels + pixel];
    }
    fit.d_pixels()[lane] = make_float4(d[0], d[1], d[2], 0);

    // Blend the same records again, with the same results. Gradients need the sums over
    // all records, which are only known now.
    const auto slot_of = [&](uint32_t j) {
        const uint32_t slot =
            fit.slot_first(region)[j] + __popcll(fit.mask(region)[j] & ((CellMask(1) << cell) - 1));
        return targets.slots + kSums * static_cast<size_t>(slot - targets.slot_base);
    };
    float2* const mine = fit.fragments() + lane;  // fragments of this lane's pixel
    float behind =
        d[0] * color[0] + d[1] * color[1] + d[2] * color[2] + d[3] * (1 - fabsf(transmittance));
    transmittance = p.inside ? 1 : -1;
    uint32_t begin = 0;
    for (; begin < list.filled && __any_sync(kAllLanes, transmittance > 0); begin += Fit::kChunk) {
        stage_records(fit, begin, list.filled);
        const uint32_t end = min(list.filled, begin + Fit::kChunk);
        for (uint32_t i = begin; i < end; i += kAtOnce) {
            const Blended blended =
                blend_records(p, records_at(fit, list, i, begin), transmittance);
#pragma unroll
            for (int q = 0; q < kAtOnce; ++q) {
                const float3& rgb = blended.color[q];
                const float by_weight = d[0] * rgb.x + d[1] * rgb.y + d[2] * rgb.z + d[3];
                behind -= blended.weight[q] * by_weight;
                mine[(i - begin + q) * 33] =
                    make_float2(exponent_vjp(blended.alpha[q], blended.before[q], blended.weight[q],
                                             by_weight, behind),
                                blended.weight[q]);
            }
        }
        __syncwarp();
        constexpr uint32_t kTogether = kCellPixels / kLanesOfSum<Fit>;
        for (uint32_t i = lane % kTogether; i - lane % kTogether < end - begin; i += kTogether) {
            const bool is_entry = begin + i < min(end, list.length);
            const uint32_t j = is_entry ? list.entry[begin + i] : fit.nothing();
            const Record<float>* const staged =
                Fit::kSmall ? nullptr : fit.staged() + lane / kCellPixels * Fit::kChunk;
            add_up(fit, p, i, Fit::kSmall ? fit.ranked()[j] : staged[i],
                   is_entry ? slot_of(j) : nullptr);
        }
        __syncwarp();
    }
    // All pixels have stopped, so the gradients of the remaining records are 0.
    for (uint32_t i = begin + lane % kCellPixels; i < list.length; i += kCellPixels) {
        float* slot = slot_of(list.entry[i]);
        for (int k = 0; k < kSums; ++k) slot[k] = 0;
    }
}

template <class Fit>
__device__ int cell_rows(const Fit& fit) {
    return (fit.job.size + kCell - 1) / kCell;
}
template <class Fit>
__device__ int cell_pairs(const Fit& fit) {
    return (fit.job.size + 2 * kCell - 1) / (2 * kCell);
}

// Maps 0, 1, 2, ... to the middle of [0, size), then to its neighbours on alternating
// sides.
__device__ inline int from_middle(int k, int size) {
    return size / 2 + (k % 2 ? -(k + 1) / 2 : k / 2);
}

// Blends all pairs of cells of some regions. Warps claim pairs from a counter. Pairs in
// the middle are claimed first, because their lists are longest.
template <Pass kPass, class Fit>
__device__ void blend_regions(const Fit& fit, const FitCameras& cameras, int num_views,
                              int first_region, int last_region, const BlendTargets& targets) {
    const int rows = cell_rows(fit), pairs = cell_pairs(fit);
    for (;;) {
        uint32_t unit = 0;
        if (threadIdx.x % 32 == 0) unit = atomicAdd(&fit.team.unit, 1u);
        unit = __shfl_sync(kAllLanes, unit, 0);
        if (unit >= static_cast<uint32_t>(num_views * rows * pairs)) return;
        const int b = unit % num_views, pair_x = unit / num_views % pairs;
        const int cell_y = from_middle(unit / num_views / pairs, rows);
        const int region = cell_y / kRegionCells * fit.regions_across + 2 * pair_x / kRegionCells;
        if (!Fit::kSmall && (region < first_region || region >= last_region)) continue;
        blend_cells<kPass>(fit, cameras, b, pair_x, cell_y, unit, targets);
        __syncwarp();
    }
}

}  // namespace cuda
}  // namespace v3dg
