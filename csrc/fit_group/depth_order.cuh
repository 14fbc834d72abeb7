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
    if (Fit::kSmall) {
        for (uint32_t j = fit.first(); j < num_views * fit.n_padded; j += fit.stride())
            rank_by_depth(fit, fit.keys() + j / fit.n_padded * fit.n_padded,
                          j / fit.n_padded * fit.n_padded, j % fit.n_padded);
        return;
    }
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
    if (Fit::kSmall || fit.team_size > 1)
        rank_by_counting(fit, num_views);
    else
        for (int b = 0; b < num_views; ++b) sort_bitonic(fit, b);
}

}  // namespace cuda
}  // namespace v3dg
