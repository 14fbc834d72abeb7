#pragma once

// Starting kernels, and what kernels need of a block and a warp.

#include "base/device.h"

namespace v3dg {
namespace cuda {

constexpr unsigned kAllLanes = 0xffffffffu;

// Starts `kernel` and checks that it started; `name` goes into the error. A grid of no blocks does nothing.
template <class... P, class... A>
void launch(const char* name, void (*kernel)(P...), dim3 grid, dim3 block, size_t shared_bytes,
            cudaStream_t stream, A&&... arguments) {
    if (grid.x == 0 || grid.y == 0 || grid.z == 0) return;
    // More than 48 KiB has to be asked for.
    if (shared_bytes > 48 * 1024)
        check(
            cudaFuncSetAttribute(reinterpret_cast<const void*>(kernel),
                                 cudaFuncAttributeMaxDynamicSharedMemorySize, static_cast<int>(shared_bytes)),
            name);
    kernel<<<grid, block, shared_bytes, stream>>>(static_cast<P>(arguments)...);
    check(cudaGetLastError(), name);
}

// Blocks of `size` threads that cover `count` elements.
inline unsigned blocks_for(size_t count, unsigned size) {
    return static_cast<unsigned>((count + size - 1) / size);
}

// The block's dynamic shared memory.
__device__ inline unsigned char* shared_memory() {
    extern __shared__ __align__(16) unsigned char bytes[];
    return bytes;
}

__device__ inline float warp_sum(float x) {
#pragma unroll
    for (int offset = 16; offset > 0; offset /= 2) x += __shfl_xor_sync(kAllLanes, x, offset);
    return x;
}

// Sums over the warp of kCount values a lane, a power of two up to 32: lane l gets the sum of v[l % kCount].
// Lanes trade halves of what they hold, so this takes about kCount shuffles where kCount warp_sum take five
// times as many. The order of the additions is fixed.
template <int kCount>
__device__ inline float warp_sums(float (&v)[kCount]) {
    const int lane = threadIdx.x % 32;
#pragma unroll
    for (int width = kCount / 2; width > 0; width /= 2) {
        const bool upper = (lane & width) != 0;
#pragma unroll
        for (int i = 0; i < width; ++i) {
            const float kept = upper ? v[i + width] : v[i], sent = upper ? v[i] : v[i + width];
            v[i] = kept + __shfl_xor_sync(kAllLanes, sent, width);
        }
    }
    float sum = v[0];
#pragma unroll
    for (int offset = kCount; offset < 32; offset *= 2) sum += __shfl_xor_sync(kAllLanes, sum, offset);
    return sum;
}

}  // namespace cuda
}  // namespace v3dg
