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
    if (shared_bytes > 0) allow_shared_memory(reinterpret_cast<const void*>(kernel), shared_bytes, name);
    kernel<<<grid, block, shared_bytes, stream>>>(static_cast<P>(arguments)...);
    check(cudaGetLastError(), name);
}

// Whether kernels can be made ready before the one before them is over: the device runs the code of one of
// the architectures that this was compiled for, the newest that is no newer than itself.
inline bool can_start_early() {
    constexpr int kFirst = 900, kCompiled[] = {__CUDA_ARCH_LIST__};
    const int capability = compute_capability();
    for (const int architecture : kCompiled)
        if (architecture >= kFirst && architecture <= capability) return true;
    return false;
}

// As launch(), for a kernel that begins with await_kernel_before(): it is made ready while the kernel before
// it is still at work, where that can be.
template <class... P, class... A>
void launch_early(const char* name, void (*kernel)(P...), dim3 grid, dim3 block, size_t shared_bytes,
                  cudaStream_t stream, A&&... arguments) {
    if (grid.x == 0 || grid.y == 0 || grid.z == 0) return;
    if (shared_bytes > 0) allow_shared_memory(reinterpret_cast<const void*>(kernel), shared_bytes, name);
    cudaLaunchAttribute early{};
    early.id = cudaLaunchAttributeProgrammaticStreamSerialization;
    early.val.programmaticStreamSerializationAllowed = 1;
    cudaLaunchConfig_t config{};
    config.gridDim = grid;
    config.blockDim = block;
    config.dynamicSmemBytes = shared_bytes;
    config.stream = stream;
    config.attrs = &early;
    config.numAttrs = can_start_early() ? 1 : 0;
    check(cudaLaunchKernelEx(&config, kernel, static_cast<P>(arguments)...), name);
}

// Waits for all that the kernel before this one has written.
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

// What a warp is to do next, in lane 0: the first `dealt` things have been dealt out, and `taken` counts the
// others, from 0. Ask early, for it takes a while to come.
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
    for (int offset = 16; offset > 0; offset /= 2) x = min(x, __shfl_xor_sync(kAllLanes, x, offset));
    return x;
}

}  // namespace cuda
}  // namespace v3dg
