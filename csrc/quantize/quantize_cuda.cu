// One thread a gaussian.

#include "base/launch.cuh"
#include "quantize/quantize.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kBlockSize = 128;

__global__ void decode_kernel(DecodeInput in, GaussianRows<float> out) {
    const size_t row = blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (row >= out.size) return;
    // The last cluster that begins at or before the gaussian; so an empty one never.
    size_t first = 0, last = in.cluster.size - 1;
    while (first < last) {
        const size_t middle = first + (last - first + 1) / 2;
        if (static_cast<size_t>(in.offset[middle]) <= row)
            first = middle;
        else
            last = middle - 1;
    }
    const int32_t cluster = in.cluster[first];
    const ClusterRanges& ranges = in.codes.ranges_of(cluster);
    const auto from = static_cast<uint32_t>(in.codes.offset[cluster] + (row - in.offset[first]));
    decode_row(in.codes.record_of(ranges, from), in.codes.sh_of(ranges, from), ranges, out, row);
}

}  // namespace

void decode(const DecodeInput& in, const GaussianRows<float>& out, Stream stream) {
    const DeviceBuffer<int32_t> cluster(in.cluster, stream);
    const DeviceBuffer<int64_t> offset(in.offset, stream);
    DecodeInput on_device = in;
    on_device.cluster.data = cluster.data();
    on_device.offset.data = offset.data();
    launch("decode", decode_kernel, blocks_for(out.size, kBlockSize), kBlockSize, 0, stream, on_device, out);
}

}  // namespace cuda
}  // namespace v3dg
