#pragma once

// Sorts the gaussians of each view by depth. Gaussians of equal depth are sorted by
// index.

#include "fit_group/team.cuh"

namespace v3dg {
namespace cuda {

// The key of gaussians that are not drawn. It is larger than the key of any depth.
constexpr uint32_t kHiddenKey = 0xfffffffeu;

// Computes the rank of gaussian `i` in its view, and writes `i` to that position.
// `view_keys` has the keys of the view.
template <class Fit>
__device__ void rank_by_depth(const Fit& fit, const uint32_t* view_keys, uint32_t begin,
                              uint32_t i) {
    const uint4* all = reinterpret_cast<const uint4*>(view_keys);
    const uint32_t key = view_keys[i], warp_first = i - threadIdx.x % 32;
    uint32_t rank = 0;
    // Equal keys are ordered by index. Therefore an equal key in an earlier run of 32
    // gaussians counts as smaller, and one in a later run as larger.
    const auto count = [&](uint32_t from, uint32_t to, const auto& before) {
        for (uint32_t run = from; run < to; run += 32) {
            uint4 other[8];
#pragma unroll
            for (int q = 0; q < 8; ++q) other[q] = all[run / 4 + q];
#pragma unroll
            for (int q = 0; q < 8; ++q) {
                const uint32_t k = run + 4 * q;
                rank += before(other[q].x, k) + before(other[q].y, k + 1);
                rank += before(other[q].z, k + 2) + before(other[q].w, k + 3);
            }
        }
    };
    count(0, warp_first, [&](uint32_t other, uint32_t) { return other <= key; });
    count(warp_first, warp_first + 32,
          [&](uint32_t other, uint32_t k) { return other < key + (k < i); });
    count(warp_first + 32, fit.n_padded, [&](uint32_t other, uint32_t) { return other < key; });
    fit.order()[begin + rank] = static_cast<typename Fit::Index>(begin + i);
}

template <class Fit>
__device__ void rank_by_counting(const Fit& fit, int num_views) {
    // All threads read all keys, so copy the keys to shared memory if there is room.
    // The same memory later holds the fragments.
    auto* copy = reinterpret_cast<uint32_t*>(shared_memory() + fit.layout.fragments);
    const bool fits = fit.n_padded * sizeof(uint32_t) <= Fit::kWarps * fragments_bytes(Fit::kChunk);
    for (int b = 0; b < num_views; ++b) {
        const uint32_t begin = b * fit.n_padded;
        __syncthreads();
        for (uint32_t i = threadIdx.x; fits && i < fit.n_padded; i += Fit::kThreads)
            copy[i] = fit.keys()[begin + i];
        __syncthreads();
        for (uint32_t i = fit.first(); i < fit.n_padded; i += fit.stride())
            rank_by_depth(fit, fits ? copy : fit.keys() + begin, begin, i);
    }
}

// Returns the number of keys that are less than `bound`, in a sorted run of 32 keys.
__device__ inline uint32_t num_below(const uint32_t* run, uint32_t bound) {
    uint32_t num = 0;
#pragma unroll
    for (uint32_t step = 16; step > 0; step /= 2)
        if (run[num + step - 1] < bound) num += step;
    return num + (run[num] < bound ? 1 : 0);
}

// Sorts the gaussians of a small group. Each warp sorts runs of 32 keys. The rank of a
// gaussian is then found by binary search in all runs of its view.
template <class Fit>
__device__ void rank_by_runs(const Fit& fit, int num_views) {
    constexpr int kMost = kViewsAtOnce * kSmallCount / Fit::kThreads;
    // The same memory later holds the fragments.
    auto* sorted = reinterpret_cast<uint32_t*>(shared_memory() + fit.layout.fragments);
    static_assert(
        kViewsAtOnce * kSmallCount * sizeof(uint32_t) <= Fit::kWarps * fragments_bytes(Fit::kChunk),
        "the sorted runs fit into the memory of the fragments");
    const uint32_t count = num_views * fit.n_padded, lane = threadIdx.x % 32;
    uint32_t in_run[kMost];
#pragma unroll
    for (int m = 0; m < kMost; ++m) {
        const uint32_t j = threadIdx.x + m * Fit::kThreads, run = j - lane;
        if (j >= count) break;
        const uint32_t key = fit.keys()[j];
        const uint4* keys = reinterpret_cast<const uint4*>(fit.keys() + run);
        uint32_t rank = 0;
#pragma unroll
        for (uint32_t q = 0; q < 8; ++q) {
            const uint4 other = keys[q];
            rank += (other.x < key + (4 * q < lane)) + (other.y < key + (4 * q + 1 < lane));
            rank += (other.z < key + (4 * q + 2 < lane)) + (other.w < key + (4 * q + 3 < lane));
        }
        sorted[run + rank] = key;
        in_run[m] = rank;
    }
    __syncthreads();
#pragma unroll
    for (int m = 0; m < kMost; ++m) {
        const uint32_t j = threadIdx.x + m * Fit::kThreads, own = j - lane;
        if (j >= count) break;
        const uint32_t key = fit.keys()[j], begin = j / fit.n_padded * fit.n_padded;
        uint32_t rank = in_run[m];
        // Equal keys are ordered by index, so those in earlier runs count as smaller.
#pragma unroll 4
        for (uint32_t run = begin; run < begin + fit.n_padded; run += 32)
            if (run != own) rank += num_below(sorted + run, key + (run < own ? 1 : 0));
        fit.order()[begin + rank] = static_cast<typename Fit::Index>(j);
    }
}

template <class Fit>
__device__ void sort_bitonic(const Fit& fit, int b) {
    auto* sorted = reinterpret_cast<unsigned long long*>(fit.at(fit.layout.sort_keys));
    uint32_t size = 32;
    while (size < fit.n) size *= 2;
    const uint32_t begin = b * fit.n_padded;
    for (uint32_t i = threadIdx.x; i < size; i += Fit::kThreads)
        sorted[i] = i < fit.n
                        ? static_cast<unsigned long long>(fit.keys()[begin + i]) << 32 | (begin + i)
                        : ~0ull;
    __syncthreads();
    for (uint32_t run = 2; run <= size; run *= 2)
        for (uint32_t stride = run / 2; stride > 0; stride /= 2) {
            for (uint32_t t = threadIdx.x; t < size / 2; t += Fit::kThreads) {
                const uint32_t low = 2 * t - (t & (stride - 1)), high = low + stride;
                const unsigned long long x = sorted[low], y = sorted[high];
                if ((x > y) == ((low & run) == 0)) {
                    sorted[low] = y;
                    sorted[high] = x;
                }
            }
            __syncthreads();
        }
    for (uint32_t i = threadIdx.x; i < fit.n_padded; i += Fit::kThreads)
        fit.order()[begin + i] = i < fit.n ? static_cast<typename Fit::Index>(sorted[i])
                                           : static_cast<typename Fit::Index>(begin + i);
    __syncthreads();
}

// Sorts the gaussians of each view by depth. Gaussians of equal depth are sorted by
// index.
template <class Fit>
__device__ void order_by_depth(const Fit& fit, int num_views) {
    if constexpr (Fit::kSmall)
        rank_by_runs(fit, num_views);
    else if (fit.team_size > 1)
        rank_by_counting(fit, num_views);
    else
        for (int b = 0; b < num_views; ++b) sort_bitonic(fit, b);
}

}  // namespace cuda
}  // namespace v3dg
