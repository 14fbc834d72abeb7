// One thread a gaussian.

#include "base/launch.cuh"
#include "quantize/quantize.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kBlockSize = 128;

__global__ void decode_kernel(PageCodes<const uint32_t> page, GaussianRows<float> out) {
    const size_t row = page.first_row() + blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (row >= page.end_row()) return;
    // The last cluster that begins at or before the gaussian; so an empty one never.
    size_t first = 0, last = page.num_clusters() - 1;
    while (first < last) {
        const size_t middle = first + (last - first + 1) / 2;
        if (static_cast<size_t>(page.offset[middle]) <= row)
            first = middle;
        else
            last = middle - 1;
    }
    const uint32_t* words = page.ranges(first);
    const auto& code = *reinterpret_cast<const ClusterCode*>(words);
    const auto* steps = reinterpret_cast<const uint16_t*>(words + sizeof(ClusterCode) / 4);
    decode_row(page, ranges_of(code, steps, page.sh_degree), row, out);
}

}  // namespace

void decode_page(const PageCodes<const uint32_t>& page, const GaussianRows<float>& out, Stream stream) {
    const size_t num_rows = page.end_row() - page.first_row();
    const DeviceBuffer<int64_t> offset(page.offset, stream);
    PageCodes<const uint32_t> on_device = page;
    on_device.offset.data = offset.data();
    launch("decode a page", decode_kernel, blocks_for(num_rows, kBlockSize), kBlockSize, 0, stream, on_device,
           out);
}

}  // namespace cuda
}  // namespace v3dg
