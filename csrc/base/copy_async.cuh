#pragma once

// Asynchronous copies from device memory to shared memory. They do not need registers.

#include <cuda_runtime.h>

namespace v3dg {
namespace cuda {

// Copies 16 or 8 bytes from device memory to shared memory. The copies of a thread are
// complete when wait_for_copies() returns in that thread.
__device__ inline void copy_async(float4* shared, const float4* from) {
#ifdef __CUDA_ARCH__
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(
                     static_cast<unsigned>(__cvta_generic_to_shared(shared))),
                 "l"(from)
                 : "memory");
#else
    *shared = *from;
#endif
}
__device__ inline void copy_async(float2* shared, const float2* from) {
#ifdef __CUDA_ARCH__
    asm volatile("cp.async.ca.shared.global [%0], [%1], 8;" ::"r"(
                     static_cast<unsigned>(__cvta_generic_to_shared(shared))),
                 "l"(from)
                 : "memory");
#else
    *shared = *from;
#endif
}
__device__ inline void wait_for_copies() {
#ifdef __CUDA_ARCH__
    asm volatile("cp.async.commit_group;\n cp.async.wait_group 0;" ::: "memory");
#endif
}

}  // namespace cuda
}  // namespace v3dg
