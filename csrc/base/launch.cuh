#pragma once

// Starting kernels, and what kernels need of a block and a warp.

#include "base/device.h"

namespace v3dg {
namespace cuda {

constexpr unsigned kAllLanes = 0xffffffffu;

// Starts `kernel` and checks that it started; `name` goes into the error. A grid of no blocks does
// nothing.
template <class... P, class... A>
void launch(const char* name, void (*kernel)(P...), dim3 grid, dim3 block, size_t shared_bytes,
            cudaStream_t stream, A&&... arguments) {
    if (grid.x == 0 || grid.y == 0 || grid.z == 0) return;
    if (shared_bytes > 0)
        allow_shared_memory(reinterpret_cast<const void*>(kernel), shared_bytes, name);
    kernel<<<grid, block, shared_bytes, stream>>>(static_cast<P>(arguments)...);
    check(cudaGetLastError(), name);
}

// As launch(), for a kernel that begins with await_kernel_before() in every block: where the device
// can do that, it is launched before the memory of the kernel before it can be seen, and waits for
// that itself.
template <class... P, class... A>
void launch_early(const char* name, void (*kernel)(P...), dim3 grid, dim3 block,
                  size_t shared_bytes, cudaStream_t stream, A&&... arguments) {
    if (grid.x == 0 || grid.y == 0 || grid.z == 0) return;
    if (shared_bytes > 0)
        allow_shared_memory(reinterpret_cast<const void*>(kernel), shared_bytes, name);
    cudaLaunchAttribute early{};
    early.id = cudaLaunchAttributeProgrammaticStreamSerialization;
    early.val.programmaticStreamSerializationAllowed = 1;
    cudaLaunchConfig_t config{};
    config.gridDim = grid;
    config.blockDim = block;
    config.dynamicSmemBytes = shared_bytes;
    config.stream = stream;
    config.attrs = &early;
    config.numAttrs = can_start_early(reinterpret_cast<const void*>(kernel)) ? 1 : 0;
    check(cudaLaunchKernelEx(&config, kernel, static_cast<P>(arguments)...), name);
}

// Waits for all that the kernel before this one has written, and so for all before that.
__device__ inline void await_kernel_before() {
#if __CUDA_ARCH__ >= 900
    cudaGridDependencySynchronize();
#endif
}

// Blocks of `size` threads that cover `count` elements.
V3DG_HD inline unsigned blocks_for(size_t count, unsigned size) {
    return static_cast<unsigned>((count + size - 1) / size);
}

// The block's dynamic shared memory.
__device__ inline unsigned char* shared_memory() {
    extern __shared__ __align__(16) unsigned char bytes[];
    return bytes;
}

// What a warp is to do next, in lane 0: the first `dealt` things have been dealt out, and `taken`
// counts the others, from 0. Ask early, for it takes a while to come.
__device__ inline unsigned take_next(unsigned* taken, unsigned dealt) {
    return threadIdx.x % 32 == 0 ? dealt + atomicAdd(taken, 1u) : 0;
}

// Over the lanes of a whole warp, in every lane. The order of the additions is fixed.
template <class T>
__device__ inline T warp_sum(T x) {
#pragma unroll
    for (int offset = 16; offset > 0; offset /= 2) x += __shfl_xor_sync(kAllLanes, x, offset);
    return x;
}
template <class T>
__device__ inline T warp_min(T x) {
#pragma unroll
    for (int offset = 16; offset > 0; offset /= 2)
        x = min(x, __shfl_xor_sync(kAllLanes, x, offset));
    return x;
}

}  // namespace cuda
}  // namespace v3dg
