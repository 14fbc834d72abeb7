// Computes the cuts of windows on CUDA. A block processes one window and all clusters
// of the table. The file is compiled without floating-point contraction, so that the
// clusters are the same as on the CPU.

#include "levels/cut_windows_cuda.h"

#include "base/scan.cuh"
#include "residency/upload.h"
#include "select/cut_math.h"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kCutThreads = 512;
constexpr unsigned kItemThreads = 256;

__device__ uint32_t items_of(const ClusterTable& table, size_t c) {
    return blocks_for(static_cast<size_t>(table.num_gaussians(c)), kItemSize);
}

__global__ void __launch_bounds__(kCutThreads)
    cut_windows_kernel(ClusterTable table, const WindowTables* windows, Shown shown,
                       int32_t* item_of_cluster, uint32_t* num_items) {
    __shared__ InstanceView view;
    __shared__ SelectRule rule;
    const unsigned w = blockIdx.x;
    if (threadIdx.x == 0) {
        view = windows->view[w];
        rule = windows->rule[w];
    }
    __syncthreads();
    const InstanceCut<AskedGroups> cut = cut_by_asking(table, view, rule);
    const size_t num_clusters = table.num_clusters();
    uint32_t done = 0;
    for (size_t first = 0; first < num_clusters; first += kCutThreads) {
        const size_t c = first + threadIdx.x;
        bool is_shown = false;
        if (c < num_clusters)
            is_shown = shown == Shown::leaves ? table.own_group[c] < 0 && !cut.is_culled(c)
                                              : cut.drawn_weight(c) > 0;
        const uint32_t num = is_shown ? items_of(table, c) : 0;
        uint32_t total;
        const uint32_t before = block_prefix(num, total);
        if (c < num_clusters)
            item_of_cluster[w * num_clusters + c] =
                num > 0 ? static_cast<int32_t>(done + before) : -1;
        done += total;
    }
    if (threadIdx.x == 0) num_items[w] = done;
}

// Launched with one thread per cluster, and one row of blocks per window.
__global__ void __launch_bounds__(kItemThreads)
    window_items_kernel(ClusterTable table, uint32_t num_windows, const int32_t* item_of_cluster,
                        const uint32_t* num_items, Appearance<float> appearance, ItemList items) {
    const unsigned w = blockIdx.y;
    unsigned long long total = 0;
    unsigned long long first = 0;
    for (uint32_t k = 0; k < num_windows; ++k) {
        if (k < w) first += num_items[k];
        total += num_items[k];
    }
    if (w == 0 && blockIdx.x == 0 && threadIdx.x == 0) {
        items.counters->items = total;
        items.counters->gaussians = kItemSize * total;
    }
    if (!items.has_room_for(total, kItemSize * total)) return;
    const size_t c = size_t(blockIdx.x) * kItemThreads + threadIdx.x;
    if (c >= table.num_clusters()) return;
    const int32_t item = item_of_cluster[w * table.num_clusters() + c];
    if (item < 0) return;
    const auto count = static_cast<uint32_t>(table.num_gaussians(c));
    for (uint32_t k = 0; k * kItemSize < count; ++k) {
        const auto number = static_cast<uint32_t>(first) + static_cast<uint32_t>(item) + k;
        items.items[number] = {
            .placement = w,
            .first = static_cast<uint32_t>(table.offset[c]) + k * kItemSize,
            .count = min(static_cast<uint32_t>(kItemSize), count - k * kItemSize),
            .record = kItemSize * number,
            .appearance = appearance,
            .sharers = 0,
            .cluster = 0,
            .weight = 1.0f};
    }
}

}  // namespace

DeviceTable::DeviceTable(const ClusterTable& table, cudaStream_t stream) : table_(table) {
    // Clear these tables, because the kernels do not read them.
    table_.top_group = {};
    table_.top_cluster = {};
    table_.pages = {};
    Upload upload;
    upload.add(table_);
    upload.finish(storage_, stream);
}

void DeviceWindows::cut(const DeviceTable& table, const WindowTables& windows, Shown shown,
                        cudaStream_t stream) {
    const size_t num_clusters = table.table().num_clusters();
    count_ = windows.count;
    const FrameImage& last = windows.image[count_ - 1];
    num_tiles_ = last.first_tile + num_tiles_of(last);
    tables_.copy_from({&windows, 1}, stream);
    item_of_cluster_.reserve(kMostWindows * num_clusters, stream);
    num_items_.reserve(kMostWindows, stream);
    launch("cut_windows_kernel", cut_windows_kernel, count_, kCutThreads, 0, stream, table.table(),
           tables_.data(), shown, item_of_cluster_.data(), num_items_.data());
}

void DeviceWindows::write_items(const DeviceTable& table, const Appearance<float>& appearance,
                                const ItemList& items, cudaStream_t stream) const {
    const dim3 grid(blocks_for(table.table().num_clusters(), kItemThreads), count_);
    launch("window_items_kernel", window_items_kernel, grid, kItemThreads, 0, stream, table.table(),
           count_, item_of_cluster_.data(), num_items_.data(), appearance, items);
}

}  // namespace cuda
}  // namespace v3dg
