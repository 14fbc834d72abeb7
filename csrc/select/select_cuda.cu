// A block takes one instance, its threads the clusters. Only flags come back; the host makes the list.

#include <cuda_runtime.h>

#include <algorithm>
#include <stdexcept>
#include <string>

#include "select/select.h"

namespace v3dg {

namespace {

constexpr int kBlockSize = 128;
constexpr int64_t kMostFlags = int64_t(1) << 26;  // device memory for flags, bytes

void check(cudaError_t error, const char* what) {
    if (error == cudaSuccess) return;
    cudaGetLastError();  // a later call must not report this error again
    throw std::runtime_error(std::string("cuda: ") + what + " failed: " + cudaGetErrorString(error));
}

template <class T>
class DeviceArray {
  public:
    explicit DeviceArray(size_t size) : size_(size) {
        if (size > 0) check(cudaMalloc(reinterpret_cast<void**>(&data_), size * sizeof(T)), "cudaMalloc");
    }
    explicit DeviceArray(Span<const T> host) : DeviceArray(host.size) {
        if (host.size > 0)
            check(cudaMemcpy(data_, host.data, host.size * sizeof(T), cudaMemcpyHostToDevice), "cudaMemcpy");
    }
    explicit DeviceArray(const std::vector<T>& host) : DeviceArray(Span<const T>{host.data(), host.size()}) {}
    DeviceArray(DeviceArray&& other) noexcept : data_(other.data_), size_(other.size_) {
        other.data_ = nullptr;
    }
    DeviceArray(const DeviceArray&) = delete;
    DeviceArray& operator=(const DeviceArray&) = delete;
    ~DeviceArray() { cudaFree(data_); }

    T* data() const { return data_; }
    operator Span<const T>() const { return {data_, size_}; }

  private:
    T* data_ = nullptr;
    size_t size_ = 0;
};

// A bundle's table with its arrays on the device.
struct DeviceTable {
    explicit DeviceTable(const ClusterTable& host)
        : ball(host.ball),
          weight(host.weight),
          own_group(host.own_group),
          parent_group(host.parent_group),
          box(host.box),
          top_group(host.top_group),
          table(host) {
        table.ball = ball;
        table.weight = weight;
        table.own_group = own_group;
        table.parent_group = parent_group;
        table.box = box;
        table.top_group = top_group;
        table.offset = {};
        table.top_cluster = {};
    }

    DeviceArray<Ball> ball;
    DeviceArray<float> weight;
    DeviceArray<int32_t> own_group, parent_group;
    DeviceArray<Box> box;
    DeviceArray<int32_t> top_group;
    ClusterTable table;
};

__global__ void select_kernel(const ClusterTable* tables, const int32_t* bundle, const InstanceView* views,
                              const int64_t* flag_offset, SelectRule rule, uint8_t* drawn) {
    const size_t i = blockIdx.x;
    const ClusterTable& table = tables[bundle[i]];
    const InstanceView& view = views[i];
    __shared__ bool is_hidden, is_top;
    if (threadIdx.x == 0) {
        is_hidden = rule.culls && is_outside(table.bounds, view);
        is_top = top_fits(table, view, rule);
    }
    __syncthreads();
    for (size_t c = threadIdx.x; c < table.own_group.size; c += blockDim.x) {
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        bool draws = !is_hidden;
        if (draws && is_top) {
            draws = parent < 0;
        } else if (draws) {
            draws = (own < 0 || fits(table, own, view, rule)) &&
                    !(parent >= 0 && fits(table, parent, view, rule));
        }
        if (draws && rule.culls) draws = !is_outside(table.box[c], view);
        drawn[flag_offset[i] + static_cast<int64_t>(c)] = draws;
    }
}

}  // namespace

int cuda::num_devices() {
    int count = 0;
    if (cudaGetDeviceCount(&count) != cudaSuccess) {
        cudaGetLastError();
        return 0;
    }
    return count;
}

void cuda::select(const SelectInput& in, SelectOutput& out) {
    std::vector<DeviceTable> device_tables;
    device_tables.reserve(in.bundles.size);
    std::vector<ClusterTable> tables;
    for (const ClusterTable& table : in.bundles) {
        device_tables.emplace_back(table);
        tables.push_back(device_tables.back().table);
    }
    const DeviceArray<ClusterTable> tables_on_device(tables);

    const size_t num_instances = in.instances.bundle.size;
    for (size_t first = 0; first < num_instances;) {
        std::vector<InstanceView> views;
        std::vector<int64_t> flag_offset{0};
        size_t last = first;
        // At least one instance at a time, and no more flags than there is room for.
        for (; last < num_instances; ++last) {
            const ClusterTable& table = in.bundles[in.instances.bundle[last]];
            const int64_t end = flag_offset.back() + static_cast<int64_t>(table.own_group.size);
            if (last > first && (end > kMostFlags || last - first == 0x7fffffff)) break;
            views.push_back(view_from_instance(in.camera, in.instances, last, table.pad_px));
            flag_offset.push_back(end);
        }
        std::vector<uint8_t> drawn(flag_offset.back());
        if (!drawn.empty()) {
            const DeviceArray<int32_t> bundle(
                Span<const int32_t>{in.instances.bundle.data + first, last - first});
            const DeviceArray<InstanceView> views_on_device(views);
            const DeviceArray<int64_t> offsets(flag_offset);
            const DeviceArray<uint8_t> flags(drawn.size());
            select_kernel<<<static_cast<unsigned>(last - first), kBlockSize>>>(
                tables_on_device.data(), bundle.data(), views_on_device.data(), offsets.data(), in.rule,
                flags.data());
            check(cudaGetLastError(), "select_kernel");
            check(cudaMemcpy(drawn.data(), flags.data(), drawn.size(), cudaMemcpyDeviceToHost), "cudaMemcpy");
        }
        for (size_t i = first; i < last; ++i) {
            const ClusterTable& table = in.bundles[in.instances.bundle[i]];
            const uint8_t* flag = drawn.data() + flag_offset[i - first];
            for (size_t c = 0; c < table.own_group.size; ++c) {
                if (!flag[c]) continue;
                out.instance.push_back(static_cast<int32_t>(i));
                out.cluster.push_back(static_cast<int32_t>(c));
                out.num_gaussians += table.offset[c + 1] - table.offset[c];
            }
        }
        first = last;
    }
}

}  // namespace v3dg
