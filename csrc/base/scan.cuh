#pragma once

// Prefix sums over the lanes of a warp, over the threads of a block, and over parts
// that blocks process in order.

#include "base/launch.cuh"

namespace v3dg {
namespace cuda {

// Returns the sum of x over the lanes up to and including this one, within each group
// of kWidth lanes. All lanes of the warp must call it.
template <unsigned kWidth = 32, class T>
__device__ inline T warp_prefix(T x) {
#pragma unroll
    for (unsigned offset = 1; offset < kWidth; offset *= 2) {
        const T below = __shfl_up_sync(kAllLanes, x, offset, kWidth);
        if (threadIdx.x % kWidth >= offset) x += below;
    }
    return x;
}

// Returns the sum of x over the threads before this one. `total` receives the sum over
// all threads. All threads of a block of whole warps must call it.
template <class T>
__device__ inline T block_prefix(T x, T& total) {
    __shared__ T warp_total[32];
    const unsigned lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    const T sum = warp_prefix(x);
    if (lane == 31) warp_total[warp] = sum;
    __syncthreads();
    T before = 0;
    total = 0;
    for (unsigned w = 0; w < blockDim.x / 32; ++w) {
        if (w < warp) before += warp_total[w];
        total += warp_total[w];
    }
    __syncthreads();  // the next call overwrites warp_total
    return before + sum - x;
}

// Returns the next value of a counter, which starts at 0. All threads of the block must
// call it, and all get the same value.
__device__ inline unsigned take_ticket(unsigned* counter) {
    __shared__ unsigned ticket;
    if (threadIdx.x == 0) ticket = atomicAdd(counter, 1u);
    __syncthreads();
    const unsigned taken = ticket;
    __syncthreads();
    return taken;
}

// Returns the sum of all parts before `part`. `sum` is the sum of this part, and must
// be below 2^62. One warp must call it once per part. `state` has one integer per part,
// initially zero. Parts must be started in ascending order, for example with
// take_ticket().
//
// Source: Merrill and Garland, Single-pass Parallel Prefix Scan with Decoupled
// Look-back, 2016.
__device__ inline unsigned long long prefix_of_part(unsigned long long* state, size_t part,
                                                    unsigned long long sum) {
    constexpr unsigned long long kOwn = 1ull << 62, kAll = 2ull << 62, kValue = kOwn - 1;
    // Number of parts that a lane reads at once, to hide the latency.
    constexpr unsigned kEach = 4;
    volatile unsigned long long* word = state;
    const unsigned lane = threadIdx.x % 32;
    if (part == 0) {
        if (lane == 0) word[0] = kAll | sum;
        return 0;
    }
    if (lane == 0) word[part] = kOwn | sum;
    unsigned long long before = 0;
    for (size_t end = part;; end -= 32 * kEach) {
        unsigned long long seen[kEach], of_lane = 0;
        bool knows_all = false, is_ready;
        do {
            is_ready = true;
#pragma unroll
            for (unsigned k = 0; k < kEach; ++k) {
                // Before the first part, all sums are 0.
                const unsigned back = kEach * lane + k;
                seen[k] = back < end ? word[end - 1 - back] : kAll;
            }
#pragma unroll
            for (unsigned k = 0; k < kEach; ++k) is_ready = is_ready && seen[k] >= kOwn;
        } while (!is_ready);
        // Each lane sums its parts backwards, up to the nearest part that has published
        // the sum of all parts including itself.
#pragma unroll
        for (unsigned k = 0; k < kEach; ++k) {
            of_lane += knows_all ? 0 : seen[k] & kValue;
            knows_all = knows_all || seen[k] >= kAll;
        }
        const unsigned is_all = __ballot_sync(kAllLanes, knows_all);
        before += warp_sum(is_all == 0 || lane < unsigned(__ffs(is_all)) ? of_lane : 0);
        if (is_all != 0) break;
    }
    if (lane == 0) word[part] = kAll | (before + sum);
    return before;
}

}  // namespace cuda
}  // namespace v3dg
