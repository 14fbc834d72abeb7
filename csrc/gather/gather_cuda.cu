// Gathers on CUDA. A thread writes the shape of a gaussian, or one of its SH bases. A
// block processes adjacent rows, so that it needs to look up only a few clusters.

#include "base/launch.cuh"
#include "gather/gather.h"
#include "gather/gather_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kBlockSize = 256;

// Returns the last of the clusters `low` to `high` that begins at or before `row`. That
// cluster is never empty.
__device__ size_t cluster_at(const Span<const int64_t>& offset, size_t low, size_t high,
                             int64_t row) {
    while (low < high) {
        const size_t middle = low + (high - low + 1) / 2;
        if (offset[middle] <= row)
            low = middle;
        else
            high = middle - 1;
    }
    return low;
}

// Launched with one thread per row of the result (num_items = 1), or per row and SH
// basis (num_items = number of bases).
__global__ void __launch_bounds__(kBlockSize)
    gather_kernel(GatherInput in, Rotations rotations, GaussianRows<float> out, int num_items) {
    const int64_t num = in.offset[in.instance.size] * num_items;
    const int64_t first = blockIdx.x * int64_t(kBlockSize);
    const int64_t last = (first + kBlockSize < num ? first + kBlockSize : num) - 1;
    __shared__ size_t cluster[2];
    if (threadIdx.x < 2)
        cluster[threadIdx.x] = cluster_at(in.offset, 0, in.instance.size - 1,
                                          (threadIdx.x == 0 ? first : last) / num_items);
    __syncthreads();
    const int64_t item = first + threadIdx.x;
    if (item > last) return;
    const int64_t row = item / num_items;
    const size_t s = cluster_at(in.offset, cluster[0], cluster[1], row);
    const int basis = static_cast<int>(item % num_items);
    gather_sh(in, rotations, s, row - in.offset[s], basis, out);
    if (basis == 0) gather_shape(in, rotations, s, row - in.offset[s], out);
}

// Replaces a host array by a copy on the device, which is freed together with this
// object.
template <class T>
class Copy {
  public:
    Copy(Span<const T>& span, cudaStream_t stream) : buffer_(span, stream) {
        span.data = buffer_.data();
    }

  private:
    DeviceBuffer<T> buffer_;
};

}  // namespace

void gather(const GatherInput& host, const GaussianRows<float>& out, Stream stream) {
    GatherInput in = host;
    const int64_t num_items = host.offset[host.instance.size] * num_sh_bases(out.sh_degree);
    const Copy<GaussianRows<const float>> bundles(in.bundles, stream);
    const Copy<int32_t> bundle(in.bundle, stream), instance(in.instance, stream);
    const Copy<double> position(in.position, stream), quaternion(in.quaternion, stream),
        scale(in.scale, stream);
    const RotationTables tables(host, out.sh_degree);
    const DeviceBuffer<double> rotation({tables.rotation.data(), tables.rotation.size()}, stream),
        bands({tables.bands.data(), tables.bands.size()}, stream);
    const Rotations rotations{rotation.data(), bands.data()};
    const Copy<float> weight(in.weight, stream);
    const Copy<InstanceFactors> factors(in.factors, stream);
    const Copy<int64_t> first_row(in.first_row, stream), offset(in.offset, stream);
    launch("gather", gather_kernel, blocks_for(num_items, kBlockSize), kBlockSize, 0, stream, in,
           rotations, out, num_sh_bases(out.sh_degree));
}

}  // namespace cuda
}  // namespace v3dg
