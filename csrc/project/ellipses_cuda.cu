#include "base/launch.cuh"
#include "project/ellipses.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr int kThreads = 256;

// Launched with one thread per gaussian.
__global__ void ellipses_kernel(EllipsesInput<float> in, Ellipses<float> out) {
    const size_t i = blockIdx.x * static_cast<size_t>(kThreads) + threadIdx.x;
    if (i < in.rows.size) in.write(i, out);
}

}  // namespace

void ellipses(const EllipsesInput<float>& in, const Ellipses<float>& out, Stream stream) {
    launch("ellipses_kernel", &ellipses_kernel, blocks_for(in.rows.size, kThreads), kThreads, 0,
           stream, in, out);
}

}  // namespace cuda
}  // namespace v3dg
