// Each block ranks the gaussians of one cell, one of the eight into which the median
// split divides a group. Then the surviving rows are compacted in ascending order.

#include <cub/device/device_select.cuh>

#include <vector>

#include "base/launch.cuh"
#include "cluster/cluster.h"
#include "simplify/simplify.h"
#include "simplify/simplify_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kBlockSize = 128;

// A cell of the split, as a range of positions in `order`, and how many of its
// gaussians survive.
struct Cell {
    int64_t first, last, share;
};

__global__ void score_kernel(GaussianRows<const float> in, const int64_t* order, size_t count,
                             double* score_at, int64_t* rows) {
    const size_t i = blockIdx.x * size_t(kBlockSize) + threadIdx.x;
    if (i >= count) return;
    const int64_t row = order[i];
    score_at[i] = prune_score(in.scales + 3 * row, in.opacities[row]);
    rows[i] = static_cast<int64_t>(i);
}

__global__ void keep_kernel(const Cell* cells, const int64_t* order, const double* score_at,
                            uint8_t* is_kept) {
    const Cell cell = cells[blockIdx.x];
    for (int64_t i = cell.first + threadIdx.x; i < cell.last; i += kBlockSize) {
        const double score = score_at[i];
        int64_t rank = 0;
        // Rows ascend within a cell, so the first of equal scores has the lowest index.
        for (int64_t k = cell.first; k < cell.last; ++k) {
            const double other = score_at[k];
            rank += other > score || (other == score && k < i);
        }
        is_kept[order[i]] = rank < cell.share;
    }
}

}  // namespace

void prune(const GaussianRows<const float>& in, Span<const int64_t> in_offset,
           Span<const int64_t> out_offset, Span<int64_t> kept, Stream stream) {
    const size_t num_groups = in_offset.size - 1,
                 count = static_cast<size_t>(in_offset[num_groups]);
    if (count == 0) return;
    std::vector<int64_t> cell_offset(num_groups * kPruneCells + 1);
    DeviceBuffer<int64_t> order(count, stream), rows(count, stream), num_kept(1, stream);
    median_split({reinterpret_cast<const Point*>(in.means), count}, in_offset, kPruneHalvings,
                 {order.data(), count}, {cell_offset.data(), cell_offset.size()}, stream);
    std::vector<Cell> cells(num_groups * kPruneCells);
    for (size_t c = 0; c < cells.size(); ++c) {
        const size_t g = c / kPruneCells;
        const CellShares shares{in_offset[g], in_offset[g + 1], out_offset[g + 1] - out_offset[g]};
        cells[c] = {cell_offset[c], cell_offset[c + 1],
                    shares.of(cell_offset[c], cell_offset[c + 1])};
    }
    const DeviceBuffer<Cell> cells_on_device(Span<const Cell>{cells.data(), cells.size()}, stream);
    DeviceBuffer<double> score_at(count, stream);
    DeviceBuffer<uint8_t> is_kept(count, stream);
    launch("prune: score", score_kernel, blocks_for(count, kBlockSize), kBlockSize, 0, stream, in,
           order.data(), count, score_at.data(), rows.data());
    launch("prune: keep", keep_kernel, static_cast<unsigned>(cells.size()), kBlockSize, 0, stream,
           cells_on_device.data(), order.data(), score_at.data(), is_kept.data());
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
