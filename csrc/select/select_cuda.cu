// Two kernels. place_kernel, a thread an instance: the camera in its frame, and how much of its table there
// is to look at: nothing when it is hidden, the top when that fits, else everything. cut_kernel, a block a
// part of kPart clusters of one instance: which are drawn, and their places in the list by a prefix sum over
// parts.

#include "select/select_cuda.h"

#include <algorithm>

#include "base/scan.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kPart = 256;         // threads of cut_kernel; clusters of a part
constexpr unsigned kPlaceThreads = 64;  // few, so that a few thousand instances spread over the device

}  // namespace

// What place_kernel finds out about an instance.
struct InstanceCut {
    InstanceView view;
    uint32_t first_part;
    bool is_top, culls;
};

namespace {

// Scratch of one cut, cleared before it; the states of parts are cleared by place_kernel.
struct Scratch {
    unsigned *place_ticket, *cut_ticket;
    unsigned* num_parts;
    unsigned long long* place_state;               // a word a block of place_kernel
    unsigned long long *unit_state, *count_state;  // a word a part
};

struct SceneOnDevice {
    const DeviceBundle* bundles;
    InstanceTable instances;
};

__global__ void place_kernel(SceneOnDevice scene, SelectCamera camera, SelectRule rule, FrameImage image,
                             FrameImage* images, Placement* placements, InstanceCut* cuts, Scratch scratch) {
    const size_t block = take_ticket(scratch.place_ticket), i = block * kPlaceThreads + threadIdx.x;
    if (i == 0 && images != nullptr) images[0] = image;
    InstanceCut cut;
    unsigned parts = 0;
    if (i < scene.instances.scale.size) {
        const int32_t b = scene.instances.bundle[i];
        const ClusterTable& table = scene.bundles[b].table;
        const Pose pose = scene.instances.pose(i);
        cut.view = view_from_instance(camera, pose, table.pad_px);
        if (placements != nullptr)
            placements[i] = {model_view_from_instance(camera, pose), static_cast<uint32_t>(b), 0};
        if (!(rule.culls && is_outside(table.bounds, cut.view))) {
            cut.culls = rule.culls && !is_inside(table.bounds, cut.view);
            cut.is_top = top_fits(table, cut.view, rule);
            const size_t clusters = cut.is_top ? table.top_cluster.size : table.own_group.size;
            parts = static_cast<unsigned>((clusters + kPart - 1) / kPart);
        }
    }
    unsigned total;
    const unsigned before_in_block = block_prefix(parts, total);
    __shared__ unsigned before_block;
    if (threadIdx.x < 32) {
        const unsigned before = static_cast<unsigned>(prefix_of_part(scratch.place_state, block, total));
        if (threadIdx.x == 0) before_block = before;
    }
    __syncthreads();
    const unsigned before = before_block;
    if (i < scene.instances.scale.size) {
        cut.first_part = before + before_in_block;
        cuts[i] = cut;
    }
    for (unsigned p = before + threadIdx.x; p < before + total; p += kPlaceThreads)
        scratch.unit_state[p] = scratch.count_state[p] = 0;
    if (block + 1 == gridDim.x && threadIdx.x == 0) *scratch.num_parts = before + total;
}

// The last instance whose parts begin at `part` or before.
__device__ size_t instance_of_part(const InstanceCut* cuts, size_t num_instances, unsigned part) {
    size_t first = 0, count = num_instances;
    while (count > 1) {
        const size_t step = (count + kPart - 1) / kPart, at = threadIdx.x * step;
        const int below = __syncthreads_count(at < count && cuts[first + at].first_part <= part);
        const size_t skip = (below - 1) * step;
        first += skip;
        count = min(step, count - skip);
    }
    return first;
}

// The selected clusters of one part, a thread a cluster.
struct DrawnCluster {
    size_t instance;
    int32_t cluster;
    unsigned size;  // gaussians; 0 when it is not drawn
    bool draws;
};

// Selected clusters as (instance, cluster).
struct PairOutput {
    int32_t *instance, *cluster;
    unsigned long long capacity;
    SceneTables::Counts* counts;

    __device__ unsigned prepare(const DeviceBundle&, const DrawnCluster& c) { return c.draws; }
    __device__ void write(const DeviceBundle&, const DrawnCluster& c, unsigned long long first,
                          unsigned long long) {
        if (!c.draws || first >= capacity) return;
        instance[first] = static_cast<int32_t>(c.instance);
        cluster[first] = c.cluster;
    }
    __device__ void finish(unsigned long long units, unsigned long long gaussians) {
        *counts = {units, gaussians};
    }
};

// Selected clusters as items. A run of clusters that are neighbours in the asset and drawn alike is cut into
// items as one; a thread writes those that begin in its cluster.
struct ItemOutput {
    ItemList items;
    unsigned offset_in_run, run_size, run_first;  // gaussians

    __device__ unsigned first_item() const { return (offset_in_run + kItemSize - 1) / kItemSize; }

    __device__ unsigned prepare(const DeviceBundle& bundle, const DrawnCluster& c) {
        __shared__ unsigned before[kPart + 1];  // gaussians of the part before each thread
        __shared__ unsigned heads[kPart / 32 + 1];
        __shared__ int32_t ids[kPart];
        unsigned total;
        const unsigned t = threadIdx.x;
        before[t] = block_prefix(c.size, total);
        ids[t] = c.draws ? c.cluster : -2;
        __syncthreads();
        bool begins = t == 0 || ids[t - 1] + 1 != ids[t];
        if (!begins && c.draws)
            begins = bundle.filters.filter_px2[c.cluster] != bundle.filters.filter_px2[c.cluster - 1] ||
                     bundle.filters.compensate[c.cluster] != bundle.filters.compensate[c.cluster - 1];
        const unsigned bits = __ballot_sync(kAllLanes, begins || !c.draws);
        if (t % 32 == 0) heads[t / 32] = bits;
        if (t == 0) {
            before[kPart] = total;
            heads[kPart / 32] = 1;  // the end ends a run
        }
        __syncthreads();
        if (!c.draws) return 0;
        unsigned word = t / 32;
        unsigned mask = heads[word] & (0xffffffffu >> (31 - t % 32));
        while (mask == 0) mask = heads[--word];  // thread 0 begins a run
        const unsigned head = 32 * word + 31 - __clz(mask);
        word = (t + 1) / 32;
        mask = heads[word] & (0xffffffffu << ((t + 1) % 32));
        while (mask == 0) mask = heads[++word];
        const unsigned end = 32 * word + __ffs(mask) - 1;
        offset_in_run = before[t] - before[head];
        run_size = before[end] - before[head];
        run_first = static_cast<unsigned>(bundle.table.offset[c.cluster]) - offset_in_run;
        return (offset_in_run + c.size + kItemSize - 1) / kItemSize - first_item();
    }
    __device__ void write(const DeviceBundle& bundle, const DrawnCluster& c, unsigned long long first,
                          unsigned long long gaussians_before) {
        if (!c.draws) return;
        const unsigned from = first_item(), to = (offset_in_run + c.size + kItemSize - 1) / kItemSize;
        for (unsigned k = from; k < to; ++k) {
            const unsigned long long at = first + (k - from);
            const unsigned skip = k * kItemSize, count = min(kItemSize, run_size - skip);
            const unsigned long long record = gaussians_before - offset_in_run + skip;
            if (at >= items.item_capacity || record + count > items.record_capacity) return;
            items.items[at] = {static_cast<uint32_t>(c.instance),
                               run_first + skip,
                               count,
                               static_cast<uint32_t>(record),
                               bundle.filters.filter_px2[c.cluster],
                               bundle.filters.compensate[c.cluster]};
        }
    }
    __device__ void finish(unsigned long long units, unsigned long long gaussians) {
        items.counters->items = units;
        items.counters->gaussians = gaussians;
    }
};

template <class Output>
__global__ void cut_kernel(SceneOnDevice scene, SelectRule rule, const InstanceCut* cuts, Scratch scratch,
                           Output output) {
    __shared__ unsigned long long before_units, before_gaussians;
    const unsigned num_parts = *scratch.num_parts;
    if (num_parts == 0 && blockIdx.x == 0 && threadIdx.x == 0) output.finish(0, 0);
    for (unsigned part = take_ticket(scratch.cut_ticket); part < num_parts;
         part = take_ticket(scratch.cut_ticket)) {
        const size_t i = instance_of_part(cuts, scene.instances.scale.size, part);
        const InstanceCut& cut = cuts[i];
        const DeviceBundle& bundle = scene.bundles[scene.instances.bundle[i]];
        const ClusterTable& table = bundle.table;
        const size_t at = size_t(part - cut.first_part) * kPart + threadIdx.x;
        DrawnCluster drawn{i, 0, 0, false};
        if (cut.is_top) {
            drawn.draws = at < table.top_cluster.size;
            if (drawn.draws) drawn.cluster = table.top_cluster[at];
        } else if (at < table.own_group.size) {
            drawn.cluster = static_cast<int32_t>(at);
            const int32_t own = table.own_group[at], parent = table.parent_group[at];
            drawn.draws = (own < 0 || fits(table, own, cut.view, rule)) &&
                          !(parent >= 0 && fits(table, parent, cut.view, rule));
        }
        if (drawn.draws && cut.culls) drawn.draws = !is_outside(table.box[drawn.cluster], cut.view);
        if (drawn.draws)
            drawn.size = static_cast<unsigned>(table.offset[drawn.cluster + 1] - table.offset[drawn.cluster]);

        unsigned num_units, num_gaussians;
        const unsigned units = block_prefix(output.prepare(bundle, drawn), num_units);
        const unsigned gaussians = block_prefix(drawn.size, num_gaussians);
        if (threadIdx.x < 64) {  // a warp each
            const bool is_units = threadIdx.x < 32;
            const unsigned long long before =
                prefix_of_part(is_units ? scratch.unit_state : scratch.count_state, part,
                               is_units ? num_units : num_gaussians);
            if (threadIdx.x % 32 == 0) (is_units ? before_units : before_gaussians) = before;
        }
        __syncthreads();
        output.write(bundle, drawn, before_units + units, before_gaussians + gaussians);
        if (part + 1 == num_parts && threadIdx.x == 0)
            output.finish(before_units + num_units, before_gaussians + num_gaussians);
    }
}

// One even for an empty scene, which has a picture, too.
unsigned place_blocks(size_t num_instances) { return std::max(1u, blocks_for(num_instances, kPlaceThreads)); }

// Words of Scratch that are cleared: three counters and the states of place_kernel's blocks.
size_t cleared_words(size_t num_instances) { return 2 + place_blocks(num_instances); }

}  // namespace

SceneTables::SceneTables(Span<const ClusterTable> tables, Span<const ClusterFilters> filters,
                         const InstanceTable& instances, cudaStream_t stream)
    : num_instances_(instances.scale.size) {
    const auto upload = [&](auto host) {
        using T = std::remove_const_t<std::remove_reference_t<decltype(host[0])>>;
        storage_.emplace_back(Span<const unsigned char>{reinterpret_cast<const unsigned char*>(host.data),
                                                        host.size * sizeof(T)},
                              stream);
        return Span<const T>{reinterpret_cast<const T*>(storage_.back().data()), host.size};
    };
    std::vector<DeviceBundle> bundles(tables.size);
    std::vector<size_t> parts(tables.size);
    for (size_t b = 0; b < tables.size; ++b) {
        ClusterTable& table = bundles[b].table;
        table = tables[b];
        table.ball = upload(table.ball);
        table.weight = upload(table.weight);
        table.own_group = upload(table.own_group);
        table.parent_group = upload(table.parent_group);
        table.box = upload(table.box);
        table.offset = upload(table.offset);
        table.top_group = upload(table.top_group);
        table.top_cluster = upload(table.top_cluster);
        if (b < filters.size)
            bundles[b].filters = {upload(filters[b].filter_px2), upload(filters[b].compensate)};
        parts[b] = (table.own_group.size + kPart - 1) / kPart;
    }
    for (const int32_t b : instances.bundle) most_parts_ += parts[b];
    bundles_.copy_from({bundles.data(), bundles.size()}, stream);
    bundle_.copy_from(instances.bundle, stream);
    position_.copy_from(instances.position, stream);
    rotation_.copy_from(instances.rotation, stream);
    scale_.copy_from(instances.scale, stream);
    cuts_.reserve(num_instances_, stream);
    scratch_.reserve(cleared_words(num_instances_) + 2 * most_parts_, stream);
}

template <class Output>
void SceneTables::cut(const SelectCamera& camera, const SelectRule& rule, const FrameImage* image,
                      FrameImage* images, Placement* placements, const Output& output, cudaStream_t stream) {
    unsigned long long* words = scratch_.data();
    const size_t cleared = cleared_words(num_instances_);
    const Scratch scratch{reinterpret_cast<unsigned*>(words),
                          reinterpret_cast<unsigned*>(words) + 1,
                          reinterpret_cast<unsigned*>(words) + 2,
                          words + 2,
                          words + cleared,
                          words + cleared + most_parts_};
    const SceneOnDevice scene{bundles_.data(),
                              {{bundle_.data(), num_instances_},
                               {position_.data(), 3 * num_instances_},
                               {rotation_.data(), 9 * num_instances_},
                               {scale_.data(), num_instances_}}};
    check(cudaMemsetAsync(words, 0, cleared * sizeof *words, stream), "cudaMemsetAsync");
    launch("place_kernel", place_kernel, place_blocks(num_instances_), kPlaceThreads, 0, stream, scene,
           camera, rule, image == nullptr ? FrameImage{} : *image, images, placements, cuts_.data(), scratch);
    const unsigned blocks =
        static_cast<unsigned>(std::max<size_t>(1, std::min<size_t>(most_parts_, 8 * num_multiprocessors())));
    launch("cut_kernel", cut_kernel<Output>, blocks, kPart, 0, stream, scene, rule, cuts_.data(), scratch,
           output);
}

void SceneTables::cut_items(const SelectCamera& camera, const SelectRule& rule, const FrameImage& image,
                            FrameImage* images, Placement* placements, const ItemList& items,
                            cudaStream_t stream) {
    cut(camera, rule, &image, images, placements, ItemOutput{items, 0, 0, 0}, stream);
}

SceneTables::Counts SceneTables::cut_pairs(const SelectCamera& camera, const SelectRule& rule,
                                           int32_t* instance, int32_t* cluster, unsigned long long capacity,
                                           cudaStream_t stream) {
    const DeviceBuffer<Counts> on_device(1, stream);
    cut(camera, rule, nullptr, nullptr, nullptr, PairOutput{instance, cluster, capacity, on_device.data()},
        stream);
    Counts counts;
    check(cudaMemcpyAsync(&counts, on_device.data(), sizeof counts, cudaMemcpyDeviceToHost, stream),
          "cudaMemcpyAsync to the host");
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
    return counts;
}

int num_devices() {
    int count = 0;
    if (cudaGetDeviceCount(&count) != cudaSuccess) {
        cudaGetLastError();
        return 0;
    }
    return count;
}

void select(const SelectInput& in, SelectOutput& out) {
    const cudaStream_t stream = nullptr;
    SceneTables scene(in.bundles, {}, in.instances, stream);
    DeviceBuffer<int32_t> instance, cluster;
    SceneTables::Counts counts{};
    // Most cuts of most scenes fit at once.
    for (unsigned long long capacity = 1u << 16;; capacity = counts.pairs) {
        instance.reserve(capacity, stream);
        cluster.reserve(capacity, stream);
        counts = scene.cut_pairs(in.camera, in.rule, instance.data(), cluster.data(), capacity, stream);
        if (counts.pairs <= capacity) break;
    }
    out.num_gaussians = static_cast<int64_t>(counts.gaussians);
    out.instance.resize(counts.pairs);
    out.cluster.resize(counts.pairs);
    if (counts.pairs == 0) return;
    for (const auto& [to, from] : {std::pair(&out.instance, &instance), std::pair(&out.cluster, &cluster)})
        check(cudaMemcpyAsync(to->data(), from->data(), counts.pairs * sizeof(int32_t),
                              cudaMemcpyDeviceToHost, stream),
              "cudaMemcpyAsync to the host");
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

}  // namespace cuda
}  // namespace v3dg
