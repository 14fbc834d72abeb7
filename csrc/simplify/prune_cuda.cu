// Pruning on CUDA. A block finds the median of a group along one axis. Then blocks rank
// the gaussians of a group within their octants. Finally, the rows that are kept are
// moved together, in ascending order.

#include <cub/device/device_select.cuh>

#include <algorithm>

#include "base/launch.cuh"
#include "math/ascending_bits.cuh"
#include "simplify/simplify.h"
#include "simplify/simplify_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kBlockSize = 128;
constexpr unsigned kMostBlocksOfGroup = 64;

// Finds the median of a group along one axis, bit by bit, beginning with the highest
// bit. For each bit, it counts the values that agree with the median's known bits and
// have a 0 next.
__global__ void median_kernel(const float* means, const int64_t* in_offset, float* medians) {
    const int64_t first = in_offset[blockIdx.x];
    const int64_t last = in_offset[blockIdx.x + 1];
    const unsigned axis = blockIdx.y;
    if (first == last) return;
    __shared__ unsigned long long num_low;
    uint32_t prefix = 0;
    int64_t rank = median_rank(last - first);
    for (int bit = 31; bit >= 0; --bit) {
        __syncthreads();
        if (threadIdx.x == 0) num_low = 0;
        __syncthreads();
        unsigned long long own_low = 0;
        for (int64_t i = first + threadIdx.x; i < last; i += kBlockSize)
            own_low += ascending_bits(means[3 * i + axis]) >> bit == prefix >> bit;
        atomicAdd(&num_low, own_low);
        __syncthreads();
        const int64_t low = static_cast<int64_t>(num_low);
        if (rank >= low) {
            rank -= low;
            prefix |= 1u << bit;
        }
    }
    if (threadIdx.x == 0) medians[3 * blockIdx.x + axis] = value_of_bits(prefix);
}

__global__ void score_kernel(GaussianRows<const float> in, size_t count, double* score_of_row,
                             int64_t* rows) {
    const size_t i = blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (i >= count) return;
    score_of_row[i] = prune_score(in.scales + 3 * i, in.opacities[i]);
    rows[i] = static_cast<int64_t>(i);
}

__global__ void octant_kernel(const float* means, const int64_t* in_offset, const float* medians,
                              uint8_t* octant_of_row) {
    const unsigned group = blockIdx.x;
    const int64_t step = int64_t(kBlockSize) * gridDim.y;
    for (int64_t i = in_offset[group] + blockIdx.y * kBlockSize + threadIdx.x;
         i < in_offset[group + 1]; i += step)
        octant_of_row[i] = static_cast<uint8_t>(octant_of(means + 3 * i, medians + 3 * group));
}

__global__ void keep_kernel(const int64_t* in_offset, const int64_t* out_offset,
                            const uint8_t* octant_of_row, const double* score_of_row,
                            uint8_t* is_kept) {
    const unsigned group = blockIdx.x;
    const int64_t first = in_offset[group];
    const int64_t last = in_offset[group + 1];
    const int64_t wanted = out_offset[group + 1] - out_offset[group];
    const int64_t step = int64_t(kBlockSize) * gridDim.y;
    for (int64_t i = first + blockIdx.y * kBlockSize + threadIdx.x; i < last; i += step) {
        const double score = score_of_row[i];
        const uint8_t octant = octant_of_row[i];
        int64_t num_before = 0;
        int64_t num_here = 0;
        int64_t rank = 0;
        for (int64_t k = first; k < last; ++k) {
            const bool is_here = octant_of_row[k] == octant;
            const double other = score_of_row[k];
            num_before += octant_of_row[k] < octant;
            num_here += is_here;
            // Equal scores are ordered by index.
            rank += is_here && (other > score || (other == score && k < i));
        }
        is_kept[i] = rank < octant_share(num_before, num_here, last - first, wanted);
    }
}

}  // namespace

void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept, Stream stream) {
    const auto num_groups = static_cast<unsigned>(in_offset.size - 1);
    const auto count = static_cast<size_t>(in_offset[num_groups]);
    if (count == 0) return;
    const DeviceBuffer<int64_t> first_row(in_offset, stream);
    const DeviceBuffer<int64_t> first_kept(out_offset, stream);
    DeviceBuffer<float> medians(size_t(3) * num_groups, stream);
    DeviceBuffer<double> score_of_row(count, stream);
    DeviceBuffer<int64_t> rows(count, stream);
    DeviceBuffer<int64_t> num_kept(1, stream);
    DeviceBuffer<uint8_t> octant_of_row(count, stream);
    DeviceBuffer<uint8_t> is_kept(count, stream);
    const unsigned blocks_of_group =
        std::min(kMostBlocksOfGroup, blocks_for(count / num_groups + 1, kBlockSize));
    const dim3 group_grid(num_groups, blocks_of_group);
    launch("prune: medians", median_kernel, dim3(num_groups, 3), kBlockSize, 0, stream, in.means,
           first_row.data(), medians.data());
    launch("prune: score", score_kernel, blocks_for(count, kBlockSize), kBlockSize, 0, stream, in,
           count, score_of_row.data(), rows.data());
    launch("prune: octants", octant_kernel, group_grid, kBlockSize, 0, stream, in.means,
           first_row.data(), medians.data(), octant_of_row.data());
    launch("prune: keep", keep_kernel, group_grid, kBlockSize, 0, stream, first_row.data(),
           first_kept.data(), octant_of_row.data(), score_of_row.data(), is_kept.data());
    const auto select = [&](void* scratch, size_t& bytes) {
        check(cub::DeviceSelect::Flagged(scratch, bytes, rows.data(), is_kept.data(), kept.data,
                                         num_kept.data(), static_cast<int64_t>(count), stream),
              "prune: select");
    };
    size_t bytes = 0;
    select(nullptr, bytes);
    DeviceBuffer<unsigned char> scratch(bytes, stream);
    select(scratch.data(), bytes);
}

}  // namespace cuda
}  // namespace v3dg
