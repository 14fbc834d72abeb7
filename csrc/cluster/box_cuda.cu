// Each warp computes one box.

#include "base/launch.cuh"
#include "cluster/box.h"
#include "cluster/box_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kBlockSize = 128;

__global__ void box_kernel(const float* means, const float* quats, const float* scales,
                           const int64_t* offset, size_t num_clusters, Box* out) {
    const size_t c = (blockIdx.x * size_t(kBlockSize) + threadIdx.x) / 32;
    if (c >= num_clusters) return;
    const unsigned lane = threadIdx.x % 32;
    Box box = no_box();
    for (int64_t i = offset[c] + lane; i < offset[c + 1]; i += 32)
        grow(box, box_of_gaussian(means + 3 * i, quats + 4 * i, scales + 3 * i));
    for (int distance = 16; distance > 0; distance /= 2) {
        Box other;
        for (int a = 0; a < 3; ++a) {
            other.lo[a] = __shfl_xor_sync(kAllLanes, box.lo[a], distance);
            other.hi[a] = __shfl_xor_sync(kAllLanes, box.hi[a], distance);
        }
        grow(box, other);
    }
    if (lane == 0) out[c] = box;
}

}  // namespace

void bound_by_boxes(const BoxInput& in, Span<Box> box, Stream stream) {
    assert(in.offset.size == box.size + 1);
    const DeviceBuffer<int64_t> offset(in.offset, stream);
    launch("bound by boxes", box_kernel, blocks_for(32 * box.size, kBlockSize), kBlockSize, 0,
           stream, in.means, in.quats, in.scales, offset.data(), box.size, box.data);
}

}  // namespace cuda
}  // namespace v3dg
