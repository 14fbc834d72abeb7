#pragma once

// Launches kernels. Also has the functions for blocks and warps that most kernels use.

#include "base/device.h"

namespace v3dg {
namespace cuda {

constexpr unsigned kAllLanes = 0xffffffffu;

// Launches `kernel` and checks for errors. `name` is used in error texts. If the grid
// has no blocks, does nothing.
template <class... P, class... A>
void launch(const char* name, void (*kernel)(P...), dim3 grid, dim3 block, size_t shared_bytes,
            cudaStream_t stream, A&&... arguments) {
    if (grid.x == 0 || grid.y == 0 || grid.z == 0) return;
    if (shared_bytes > 0)
        allow_shared_memory(reinterpret_cast<const void*>(kernel), shared_bytes, name);
    kernel<<<grid, block, shared_bytes, stream>>>(static_cast<P>(arguments)...);
    check(cudaGetLastError(), name);
}

// Like launch(), for a kernel whose blocks first call await_kernel_before(). If the
// device supports it, the blocks start before the preceding kernel has ended, which
// hides latency.
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

// Waits until the writes of the preceding kernel, and of all kernels before it, are
// visible.
__device__ inline void await_kernel_before() {
#if __CUDA_ARCH__ >= 900
    cudaGridDependencySynchronize();
#endif
}

// Returns the number of blocks of `size` threads for `count` elements.
V3DG_HD inline unsigned blocks_for(size_t count, unsigned size) {
    return static_cast<unsigned>((count + size - 1) / size);
}

// Returns the block's dynamic shared memory.
__device__ inline unsigned char* shared_memory() {
    extern __shared__ __align__(16) unsigned char bytes[];
    return bytes;
}

// Returns, in lane 0, the index of the next work item of a warp. The first `dealt`
// items are assigned statically, and `taken` counts the items that are assigned here.
// It must initially be 0. Call this function early, because the atomic operation has a
// long latency.
__device__ inline unsigned take_next(unsigned* taken, unsigned dealt) {
    return threadIdx.x % 32 == 0 ? dealt + atomicAdd(taken, 1u) : 0;
}

// Return the sum and the minimum over the lanes of a warp, in every lane. The order of
// additions is fixed. All lanes of the warp must call them.
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
