// Two steps. place_kernel, a thread an instance: the camera in its frame, and what there is to look at:
// nothing when it is hidden, its top clusters when those are the cut, else its table. That is dealt out as
// parts: 256 clusters of a table, or the tops of up to 32 neighbouring instances. cut_kernel, a warp a part:
// which clusters are drawn, and their places in the list by a prefix sum over parts.
//
// A budget puts two kernels in between: one adds up by how much each tolerance changes the cut, one chooses.

#include "select/select_cuda.h"

#include <algorithm>

#include "base/scan.cuh"

namespace v3dg {
namespace cuda {

// Clusters [first, first + kPartSize) of one instance's table; or where `tops` is not zero, the top clusters
// of instance + k for its bits k.
struct CutPart {
    uint32_t instance, first, tops;
};

namespace {

constexpr unsigned kEach = 8;  // clusters of a part that a lane looks at
constexpr unsigned kPartSize = 32 * kEach;
constexpr unsigned kCutThreads = 256, kCutWarps = kCutThreads / 32;
constexpr unsigned kPlaceThreads = 64;  // few, so that a few thousand instances spread over the device
constexpr unsigned kChooseThreads = 1024;
static_assert(kEach <= 8, "a byte says which top clusters are drawn");

using Count = unsigned long long;

// Scratch of one cut, cleared before it; the states of the cut are cleared by place_kernel.
struct Scratch {
    unsigned *place_ticket, *cut_ticket;
    unsigned* num_parts;
    Count* place_state;               // a word a block of place_kernel
    Count *unit_state, *count_state;  // a word a ticket of cut_kernel
};

struct SceneOnDevice {
    const DeviceBundle* bundles;
    InstanceTable instances;
    InstanceView* views;  // of instances whose tables are looked at
    uint8_t* tops;        // of those whose tops are the cut: a bit for each that is drawn
    CutPart* parts;
};

enum class Look { nothing, tops, table };

__device__ Look place_instance(const SceneOnDevice& scene, size_t i, const SelectCamera& camera,
                               const SelectRule& rule, Placement* placements) {
    const Pose pose = scene.instances.pose(i);
    if (!is_placed(pose)) return Look::nothing;
    const int32_t b = scene.instances.bundle[i];
    const ClusterTable& table = scene.bundles[b].table;
    const InstanceAxes axes = axes_of_instance(camera, pose);
    const InstanceView view =
        view_from_instance(camera, axes, pose, scene.instances.importance[i], table.pad_px);
    if (rule.culls && is_outside(table.bounds, view)) return Look::nothing;
    if (placements != nullptr)
        placements[i] = {model_view_from_instance(axes, pose), static_cast<uint32_t>(b), 0};
    if (table.top_cluster.size > kEach || !top_fits(table, view, rule)) {
        scene.views[i] = view;
        return Look::table;
    }
    unsigned drawn = 0;
    for (unsigned k = 0; k < table.top_cluster.size; ++k)
        if (!rule.culls || !is_outside(table.box[table.top_cluster[k]], view)) drawn |= 1u << k;
    scene.tops[i] = static_cast<uint8_t>(drawn);
    return drawn != 0 ? Look::tops : Look::nothing;
}

__global__ void place_kernel(SceneOnDevice scene, SelectCamera camera, SelectRule rule, FrameImage image,
                             FrameImage* images, Placement* placements, Scratch scratch) {
    const size_t block = take_ticket(scratch.place_ticket), i = block * kPlaceThreads + threadIdx.x;
    if (i == 0 && images != nullptr) images[0] = image;
    const size_t num_instances = scene.instances.scale.size;
    const Look look = i < num_instances ? place_instance(scene, i, camera, rule, placements) : Look::nothing;

    // Tops of neighbours, with no table in between, make one part. The first of them deals it out.
    const unsigned lane = threadIdx.x % 32, below = (1u << lane) - 1;
    const unsigned tops = __ballot_sync(kAllLanes, look == Look::tops);
    const unsigned tables = __ballot_sync(kAllLanes, look == Look::table);
    const unsigned table_below = tables & below, table_above = tables & ~below;
    const unsigned from = table_below != 0 ? 32 - __clz(static_cast<int>(table_below)) : 0;
    const unsigned to = table_above != 0 ? __ffs(table_above) - 1 : 32;
    const bool begins = look == Look::tops && (tops & below) >> from == 0;
    unsigned parts = begins ? 1 : 0;
    if (look == Look::table)
        parts = blocks_for(scene.bundles[scene.instances.bundle[i]].table.own_group.size, kPartSize);

    unsigned total;
    const unsigned before_in_block = block_prefix(parts, total);
    __shared__ unsigned before_block;
    if (threadIdx.x < 32) {
        const unsigned before = static_cast<unsigned>(prefix_of_part(scratch.place_state, block, total));
        if (threadIdx.x == 0) before_block = before;
    }
    __syncthreads();
    const unsigned before = before_block;
    CutPart* part = scene.parts + before + before_in_block;
    if (begins) {
        const unsigned until = to < 32 ? (1u << to) - 1 : kAllLanes;
        *part = {static_cast<uint32_t>(i), 0, (tops & until) >> lane};
    } else {
        for (unsigned p = 0; p < parts; ++p) part[p] = {static_cast<uint32_t>(i), p * kPartSize, 0};
    }
    // Those tickets whose first part is one of the block's.
    for (unsigned t = blocks_for(before, kCutWarps) + threadIdx.x; t < blocks_for(before + total, kCutWarps);
         t += kPlaceThreads)
        scratch.unit_state[t] = scratch.count_state[t] = 0;
    if (block + 1 == gridDim.x && threadIdx.x == 0) *scratch.num_parts = before + total;
}

// What a lane has of a part: clusters of one instance, and a bit for each that is drawn.
struct LaneClusters {
    const DeviceBundle* bundle;
    uint32_t instance;
    uint32_t first;  // of a table
    bool are_tops;
    unsigned drawn;

    __device__ int32_t cluster(unsigned k) const {
        return are_tops ? bundle->table.top_cluster[k] : static_cast<int32_t>(first + k);
    }
    __device__ unsigned size(unsigned k) const {
        const int32_t c = cluster(k);
        return static_cast<unsigned>(bundle->table.offset[c + 1] - bundle->table.offset[c]);
    }
};

// Without `drawn` where it is a table that is looked at.
__device__ LaneClusters clusters_of_lane(const SceneOnDevice& scene, const CutPart& part) {
    const unsigned lane = threadIdx.x % 32;
    LaneClusters mine{nullptr, part.instance, part.first + kEach * lane, part.tops != 0, 0};
    if (mine.are_tops) {
        if ((part.tops >> lane & 1) == 0) return mine;
        mine.instance += lane;
        mine.drawn = scene.tops[mine.instance];
    }
    mine.bundle = &scene.bundles[scene.instances.bundle[mine.instance]];
    return mine;
}

// Calls visit(k, cluster) for the clusters of a table that the lane looks at.
template <class Visit>
__device__ void for_each_cluster(const LaneClusters& mine, const Visit& visit) {
    for (unsigned k = 0; k < kEach; ++k)
        if (mine.first + k < mine.bundle->table.own_group.size)
            visit(k, static_cast<int32_t>(mine.first + k));
}

__device__ unsigned drawn_of_table(const SceneOnDevice& scene, const LaneClusters& mine,
                                   const SelectRule& rule) {
    const ClusterTable& table = mine.bundle->table;
    const InstanceView& view = scene.views[mine.instance];
    unsigned drawn = 0;
    int32_t last_parent = -1;
    bool last_fits = false;
    for_each_cluster(mine, [&](unsigned k, int32_t c) {
        const int32_t own = table.own_group[c], parent = table.parent_group[c];
        if (parent >= 0 && parent != last_parent) {
            last_parent = parent;
            last_fits = fits(table, parent, view, rule);
        }
        if ((parent >= 0 && last_fits) || (own >= 0 && !fits(table, own, view, rule))) return;
        if (!rule.culls || !is_outside(table.box[c], view)) drawn |= 1u << k;
    });
    return drawn;
}

// Adds to `change` what count_instance of the CPU's half does.
__global__ void change_kernel(SceneOnDevice scene, SelectRule rule, const unsigned* num_parts,
                              Count* change) {
    __shared__ Count at_first;
    if (threadIdx.x == 0) at_first = 0;
    __syncthreads();
    for (unsigned p = blockIdx.x * kCutWarps + threadIdx.x / 32; p < *num_parts; p += gridDim.x * kCutWarps) {
        const LaneClusters mine = clusters_of_lane(scene, scene.parts[p]);
        Count kept = 0;
        if (mine.are_tops) {
            for (unsigned k = 0; k < kEach; ++k)
                if (mine.drawn >> k & 1) kept += mine.size(k);
        } else {
            const ClusterTable& table = mine.bundle->table;
            const InstanceView& view = scene.views[mine.instance];
            for_each_cluster(mine, [&](unsigned k, int32_t c) {
                const int32_t own = table.own_group[c], parent = table.parent_group[c];
                const uint32_t first = own < 0 ? 0 : bin_of_group(table, own, view, rule),
                               last = parent < 0 ? kNumBudgetBins : bin_of_group(table, parent, view, rule);
                if (first >= last || (rule.culls && is_outside(table.box[c], view))) return;
                const Count size = mine.size(k);
                if (first == 0)
                    kept += size;
                else
                    atomicAdd(&change[first], size);
                if (last < kNumBudgetBins) atomicAdd(&change[last], ~size + 1);
            });
        }
        kept = warp_sum(kept);
        if (threadIdx.x % 32 == 0 && kept > 0) atomicAdd(&at_first, kept);
    }
    __syncthreads();
    if (threadIdx.x == 0 && at_first > 0) atomicAdd(&change[0], at_first);
}

// One block. The least tolerance whose cut is within the budget; where there is none, nothing is left to cut.
__global__ void choose_kernel(SelectRule rule, const Count* change, CutChoice* choice, unsigned* num_parts) {
    constexpr uint32_t kOwn = (kNumBudgetBins + kChooseThreads - 1) / kChooseThreads;
    __shared__ uint32_t chosen;
    if (threadIdx.x == 0) chosen = kNumBudgetBins;
    const uint32_t first = kOwn * threadIdx.x, last = min(first + kOwn, kNumBudgetBins);
    Count sum = 0;
    for (uint32_t bin = first; bin < last; ++bin) sum += change[bin];
    Count total, count = block_prefix(sum, total);  // which waits for the others
    for (uint32_t bin = first; bin < last; ++bin) {
        count += change[bin];
        if (count > rule.budget) continue;
        atomicMin(&chosen, bin);
        break;
    }
    __syncthreads();
    if (threadIdx.x != 0) return;
    const bool fits_budget = chosen < kNumBudgetBins;
    *choice = {fits_budget ? tolerance_of_bin(chosen, rule.tolerance_px2) : INFINITY, !fits_budget, total};
    if (!fits_budget) *num_parts = 0;
}

// Selected clusters as (instance, cluster).
struct PairOutput {
    int32_t *instance, *cluster;
    Count capacity;
    Count *pairs, *gaussians;

    __device__ unsigned units(unsigned) const { return 1; }
    __device__ void write(const LaneClusters& c, unsigned k, Count first, Count) const {
        if (first >= capacity) return;
        instance[first] = static_cast<int32_t>(c.instance);
        cluster[first] = c.cluster(k);
    }
    __device__ void finish(Count units, Count gaussians_drawn) const {
        *pairs = units;
        *gaussians = gaussians_drawn;
    }
};

// Selected clusters as items.
struct ItemOutput {
    ItemList items;

    __device__ unsigned units(unsigned size) const { return (size + kItemSize - 1) / kItemSize; }
    __device__ void write(const LaneClusters& c, unsigned k, Count first, Count record) const {
        const int32_t cluster = c.cluster(k);
        const unsigned size = c.size(k);
        const uint32_t gaussian = static_cast<uint32_t>(c.bundle->table.offset[cluster]);
        const float filter_px2 = c.bundle->filters.filter_px2[cluster];
        const uint32_t compensate = c.bundle->filters.compensate[cluster];
        for (unsigned skip = 0; skip < size; skip += kItemSize, ++first) {
            const unsigned count = min(static_cast<unsigned>(kItemSize), size - skip);
            if (first >= items.item_capacity || record + skip + count > items.record_capacity) return;
            items.items[first] = {c.instance, gaussian + skip, count, static_cast<uint32_t>(record) + skip,
                                  filter_px2, compensate};
        }
    }
    __device__ void finish(Count units, Count gaussians) const {
        items.counters->items = units;
        items.counters->gaussians = gaussians;
    }
};

// The block's share of ticket `ticket` of a list, each thread with the clusters that it draws.
template <class Output>
__device__ void write_clusters(const LaneClusters& mine, unsigned ticket, bool is_last, Count* unit_state,
                               Count* count_state, const Output& output) {
    __shared__ Count before_units, before_gaussians;
    unsigned units = 0, gaussians = 0;
    for (unsigned k = 0; k < kEach; ++k)
        if (mine.drawn >> k & 1) {
            const unsigned size = mine.size(k);
            units += output.units(size);
            gaussians += size;
        }
    unsigned num_units, num_gaussians;
    const unsigned units_before = block_prefix(units, num_units),
                   gaussians_before = block_prefix(gaussians, num_gaussians);
    if (threadIdx.x < 64) {  // a warp each
        const bool is_units = threadIdx.x < 32;
        const Count before =
            prefix_of_part(is_units ? unit_state : count_state, ticket, is_units ? num_units : num_gaussians);
        if (threadIdx.x % 32 == 0) (is_units ? before_units : before_gaussians) = before;
    }
    __syncthreads();
    Count unit = before_units + units_before, gaussian = before_gaussians + gaussians_before;
    for (unsigned k = 0; k < kEach; ++k)
        if (mine.drawn >> k & 1) {
            const unsigned size = mine.size(k);
            output.write(mine, k, unit, gaussian);
            unit += output.units(size);
            gaussian += size;
        }
    if (is_last && threadIdx.x == 0)
        output.finish(before_units + num_units, before_gaussians + num_gaussians);
}

template <class Output>
__global__ void __launch_bounds__(kCutThreads)
    cut_kernel(SceneOnDevice scene, SelectRule rule, const CutChoice* choice, Scratch scratch,
               Output output) {
    const unsigned num_parts = *scratch.num_parts, num_tickets = blocks_for(num_parts, kCutWarps);
    if (num_tickets == 0 && blockIdx.x == 0 && threadIdx.x == 0) output.finish(0, 0);
    if (rule.budget != kNoBudget) rule.tolerance_px2 = choice->tolerance_px2;
    for (unsigned ticket = take_ticket(scratch.cut_ticket); ticket < num_tickets;
         ticket = take_ticket(scratch.cut_ticket)) {
        const unsigned p = ticket * kCutWarps + threadIdx.x / 32;
        LaneClusters mine{};
        if (p < num_parts) {
            mine = clusters_of_lane(scene, scene.parts[p]);
            if (!mine.are_tops) mine.drawn = drawn_of_table(scene, mine, rule);
        }
        write_clusters(mine, ticket, ticket + 1 == num_tickets, scratch.unit_state, scratch.count_state,
                       output);
    }
}

// A thread an instance.
__global__ void place_all_kernel(SceneOnDevice scene, SelectCamera camera, FrameImage image,
                                 FrameImage* images, Placement* placements) {
    const size_t i = size_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i == 0) images[0] = image;
    if (i >= scene.instances.scale.size) return;
    const Pose pose = scene.instances.pose(i);
    placements[i] = {model_view_from_instance(axes_of_instance(camera, pose), pose),
                     static_cast<uint32_t>(scene.instances.bundle[i]), 0};
}

// A thread kEach pairs. The pairs of instances without a pose are left out.
__global__ void __launch_bounds__(kCutThreads)
    given_kernel(SceneOnDevice scene, Span<const int32_t> instance, Span<const int32_t> cluster,
                 Scratch scratch, ItemOutput output) {
    const unsigned ticket = take_ticket(scratch.cut_ticket);
    const size_t p = size_t(ticket) * kCutThreads + threadIdx.x;
    LaneClusters mine{};
    if (p < instance.size && is_placed(scene.instances.pose(instance[p])))
        mine = {&scene.bundles[scene.instances.bundle[instance[p]]], static_cast<uint32_t>(instance[p]),
                static_cast<uint32_t>(cluster[p]), false, 1};
    write_clusters(mine, ticket, ticket + 1 == gridDim.x, scratch.unit_state, scratch.count_state, output);
}

// At least one: an empty scene has a picture, too.
unsigned place_blocks(size_t num_instances) { return std::max(1u, blocks_for(num_instances, kPlaceThreads)); }

// Words of Scratch before the states of the cut: three counters and the states of place_kernel's blocks.
size_t cleared_words(size_t num_instances) { return 2 + place_blocks(num_instances); }

Scratch scratch_in(Count* words, size_t num_instances, size_t num_tickets) {
    auto* counters = reinterpret_cast<unsigned*>(words);
    Count* states = words + cleared_words(num_instances);
    return {counters, counters + 1, counters + 2, words + 2, states, states + num_tickets};
}

template <class T>
void copy(DeviceBuffer<T>& to, Span<const T> from, cudaStream_t stream) {
    to.reserve(from.size, stream);
    if (from.size > 0)
        check(cudaMemcpyAsync(to.data(), from.data, from.size * sizeof(T), cudaMemcpyDefault, stream),
              "cudaMemcpyAsync to the device");
}

template <class T>
void copy_to_host(T* to, const T* from, size_t count, cudaStream_t stream) {
    if (count > 0)
        check(cudaMemcpyAsync(to, from, count * sizeof(T), cudaMemcpyDeviceToHost, stream),
              "cudaMemcpyAsync to the host");
}

}  // namespace

SceneTables::SceneTables(Span<const ClusterTable> tables, Span<const ClusterFilters> filters,
                         cudaStream_t stream) {
    const auto upload = [&](auto host) {
        using T = std::remove_const_t<std::remove_reference_t<decltype(host[0])>>;
        storage_.emplace_back(Span<const unsigned char>{reinterpret_cast<const unsigned char*>(host.data),
                                                        host.size * sizeof(T)},
                              stream);
        return Span<const T>{reinterpret_cast<const T*>(storage_.back().data()), host.size};
    };
    std::vector<DeviceBundle> bundles(tables.size);
    for (size_t b = 0; b < tables.size; ++b) {
        ClusterTable& table = bundles[b].table;
        table = tables[b];
        table.ball = upload(table.ball);
        table.weight = upload(table.weight);
        table.level = upload(table.level);
        table.own_group = upload(table.own_group);
        table.parent_group = upload(table.parent_group);
        table.box = upload(table.box);
        table.offset = upload(table.offset);
        table.top_group = upload(table.top_group);
        table.top_cluster = upload(table.top_cluster);
        bundles[b].filters = {upload(filters[b].filter_px2), upload(filters[b].compensate)};
        num_clusters_.push_back(table.own_group.size);
    }
    bundles_.copy_from({bundles.data(), bundles.size()}, stream);
}

void SceneTables::set_instances(const InstanceTable& instances, cudaStream_t stream) {
    const size_t count = instances.scale.size;
    bundle_of_instance_.assign(instances.bundle.begin(), instances.bundle.end());
    most_parts_ = 0;
    for (const int32_t b : bundle_of_instance_)
        most_parts_ += std::max<size_t>(1, blocks_for(num_clusters_[b], kPartSize));
    bundle_.copy_from(instances.bundle, stream);
    importance_.copy_from(instances.importance, stream);
    set_poses(instances.position, instances.quaternion, instances.scale, stream);
    views_.reserve(count, stream);
    tops_.reserve(count, stream);
    parts_.reserve(most_parts_, stream);
    scratch_.reserve(cleared_words(count) + 2 * blocks_for(most_parts_, kCutWarps), stream);
}

void SceneTables::set_poses(Span<const double> position, Span<const double> quaternion,
                            Span<const double> scale, cudaStream_t stream) {
    copy(position_, position, stream);
    copy(quaternion_, quaternion, stream);
    copy(scale_, scale, stream);
}

InstanceTable SceneTables::instances() const {
    const size_t count = num_instances();
    return {{bundle_.data(), count},
            {position_.data(), 3 * count},
            {quaternion_.data(), 4 * count},
            {scale_.data(), count},
            {importance_.data(), count}};
}

template <class Output>
void SceneTables::cut(const SelectCamera& camera, const SelectRule& rule, const FrameImage* image,
                      FrameImage* images, Placement* placements, CutChoice* choice, const Output& output,
                      cudaStream_t stream) {
    const size_t count = num_instances();
    const Scratch scratch = scratch_in(scratch_.data(), count, blocks_for(most_parts_, kCutWarps));
    const SceneOnDevice scene{bundles_.data(), instances(), views_.data(), tops_.data(), parts_.data()};
    const unsigned blocks = static_cast<unsigned>(std::clamp<size_t>(
        blocks_for(most_parts_, kCutWarps), 1, (2048 / kCutThreads) * num_multiprocessors()));
    check(cudaMemsetAsync(scratch_.data(), 0, cleared_words(count) * sizeof(Count), stream),
          "cudaMemsetAsync");
    launch("place_kernel", place_kernel, place_blocks(count), kPlaceThreads, 0, stream, scene, camera, rule,
           image == nullptr ? FrameImage{} : *image, images, placements, scratch);
    if (rule.budget != kNoBudget) {
        Count* change = change_.reserve(kNumBudgetBins, stream);
        check(cudaMemsetAsync(change, 0, kNumBudgetBins * sizeof(Count), stream), "cudaMemsetAsync");
        launch("change_kernel", change_kernel, blocks, kCutThreads, 0, stream, scene, rule, scratch.num_parts,
               change);
        launch("choose_kernel", choose_kernel, 1, kChooseThreads, 0, stream, rule, change, choice,
               scratch.num_parts);
    }
    launch("cut_kernel", cut_kernel<Output>, blocks, kCutThreads, 0, stream, scene, rule, choice, scratch,
           output);
}

void SceneTables::cut_items(const SelectCamera& camera, const SelectRule& rule, const FrameImage& image,
                            FrameImage* images, Placement* placements, const ItemList& items,
                            cudaStream_t stream) {
    cut(camera, rule, &image, images, placements, &items.counters->choice, ItemOutput{items}, stream);
}

void SceneTables::given_items(const SelectCamera& camera, Span<const int32_t> instance,
                              Span<const int32_t> cluster, const FrameImage& image, FrameImage* images,
                              Placement* placements, const ItemList& items, cudaStream_t stream) {
    const SceneOnDevice scene{bundles_.data(), instances(), nullptr, nullptr, nullptr};
    const unsigned blocks = std::max(1u, blocks_for(instance.size, kCutThreads));
    const size_t words = cleared_words(0) + 2 * size_t(blocks);
    const Scratch scratch = scratch_in(scratch_.reserve(words, stream), 0, blocks);
    check(cudaMemsetAsync(scratch_.data(), 0, words * sizeof(Count), stream), "cudaMemsetAsync");
    launch("place_all_kernel", place_all_kernel, place_blocks(num_instances()), kPlaceThreads, 0, stream,
           scene, camera, image, images, placements);
    launch("given_kernel", given_kernel, blocks, kCutThreads, 0, stream, scene, instance, cluster, scratch,
           ItemOutput{items});
}

void SceneTables::select(const SelectCamera& camera, const SelectRule& rule, SelectOutput& out,
                         cudaStream_t stream) {
    Pairs* on_device = pairs_.reserve(1, stream);
    Pairs counts{};
    // Most cuts of most scenes fit at once.
    for (Count capacity = std::max<Count>(1u << 16, pair_instance_.capacity());; capacity = counts.pairs) {
        const PairOutput output{pair_instance_.reserve(capacity, stream),
                                pair_cluster_.reserve(capacity, stream), capacity, &on_device->pairs,
                                &on_device->gaussians};
        check(cudaMemsetAsync(on_device, 0, sizeof *on_device, stream), "cudaMemsetAsync");
        cut(camera, rule, nullptr, nullptr, nullptr, &on_device->choice, output, stream);
        copy_to_host(&counts, on_device, 1, stream);
        check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
        if (counts.pairs <= capacity) break;
    }
    const bool has_budget = rule.budget != kNoBudget;
    out.fits_budget = !has_budget || !counts.choice.exceeds_budget;
    out.tolerance_px2 = has_budget ? counts.choice.tolerance_px2 : rule.tolerance_px2;
    out.num_gaussians = static_cast<int64_t>(out.fits_budget ? counts.gaussians : counts.choice.least);
    out.instance.resize(counts.pairs);
    out.cluster.resize(counts.pairs);
    copy_to_host(out.instance.data(), pair_instance_.data(), counts.pairs, stream);
    copy_to_host(out.cluster.data(), pair_cluster_.data(), counts.pairs, stream);
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

int num_devices() {
    int count = 0;
    if (cudaGetDeviceCount(&count) != cudaSuccess) {
        cudaGetLastError();
        return 0;
    }
    return count;
}

}  // namespace cuda
}  // namespace v3dg
