// Decodes gaussians with one thread each, and writes pages to slots with one block
// each.

#include "base/launch.cuh"
#include "quantize/quantize.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kBlockSize = 128;

__global__ void decode_kernel(DecodeInput in, GaussianRows<float> out) {
    const size_t row = blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (row >= out.size) return;
    // Find the last cluster that begins at or before the row. It is never empty.
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

// Launched with one block per page.
__global__ void write_slots_kernel(const SlotPage* pages, CodeSlots to) {
    const SlotPage from = pages[blockIdx.x];
    const size_t first = from.page.first_row(), count = from.page.end_row() - first;
    const auto* records = reinterpret_cast<const uint4*>(from.page.record(first));
    auto* own_records = reinterpret_cast<uint4*>(to.records) + from.row;
    for (size_t i = threadIdx.x; i < count; i += blockDim.x) own_records[i] = records[i];
    const auto* sh = reinterpret_cast<const uint2*>(from.page.sh(first));
    auto* own_sh = reinterpret_cast<uint2*>(to.sh) + to.sh_stride * from.row;
    const size_t width = from.page.sh_degree;
    for (size_t i = threadIdx.x; i < width * count; i += blockDim.x)
        own_sh[i / width * to.sh_stride + i % width] = sh[i];
    for (size_t k = threadIdx.x; k < from.num_clusters; k += blockDim.x) write_cluster(from, k, to);
}

}  // namespace

void decode(const DecodeInput& in, const GaussianRows<float>& out, Stream stream) {
    const DeviceBuffer<int32_t> cluster(in.cluster, stream);
    const DeviceBuffer<int64_t> offset(in.offset, stream);
    DecodeInput on_device = in;
    on_device.cluster.data = cluster.data();
    on_device.offset.data = offset.data();
    launch("decode", decode_kernel, blocks_for(out.size, kBlockSize), kBlockSize, 0, stream,
           on_device, out);
}

void write_slots(const SlotPage* pages, size_t num_pages, const CodeSlots& to, Stream stream) {
    static_assert(kRecordWords == 4, "a record is loaded as one vector of four words");
    launch("write_slots", write_slots_kernel, static_cast<unsigned>(num_pages), kBlockSize, 0,
           stream, pages, to);
}

}  // namespace cuda
}  // namespace v3dg
