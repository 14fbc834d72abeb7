// Projects the items of a frame on CUDA.
//
// A warp processes one item at a time. It tests the bounding spheres of 32 gaussians at
// once (sphere_test.cuh). Gaussians that pass the test enter a queue. When the queue
// has 32 gaussians, the warp projects them (write_records.cuh). So all lanes do useful
// work, and the records of an item are in order without synchronisation between warps.
// If nearly all of 32 gaussians pass, the warp projects the next gaussians without the
// test, which would cost more than it saves.
//
// A shared item is one cluster that several placements draw. A warp then processes one
// gaussian at a time for up to 32 placements. Many distant instances of a small cluster
// thus become a few items with full warps, and each gaussian is read once. Shared items
// have a kernel of their own, because they need more registers.

#include "project/project_cuda.h"

#include "base/launch.cuh"
#include "frame/count_tile.cuh"
#include "project/project_math.h"
#include "project/sources.cuh"
#include "project/sphere_test.cuh"
#include "project/warp_space.cuh"
#include "project/write_records.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kBlocks = 4;  // resident blocks per multiprocessor
// drop_missed_rows() is applied to an item if at least kManySmall of its first 32
// gaussians have a half extent below kSmall px.
constexpr float kSmall = 3;
constexpr unsigned kManySmall = 4;
// If at least kNearlyAll of 32 gaussians pass the sphere test, the next gaussians skip
// the test. It resumes when fewer than kMany of 32 gaussians become records.
constexpr unsigned kNearlyAll = 22, kMany = 12;

// Projects the item whose tables the warp has loaded, and returns its number of
// records. `factors` points to the factors of the item's placement or, in a shared
// item, of all its placements. It is null if the source does not use factors.
template <class Source, bool kIsShared, class C>
__device__ unsigned project_item(WarpSpace<typename Source::Model>& space, const Placement* sharers,
                                 const InstanceFactors* factors, FrameCounters& counters,
                                 const ProjectOutput& out, unsigned& num_in_frustum) {
    constexpr unsigned kRound = kIsShared ? 1 : 32;  // number of gaussians per
                                                     // iteration
    const auto& tables = space.tables;
    const unsigned lane = threadIdx.x % 32, count = tables.item.count;
    if (lane == 0) space.num_large = 0;
    const bool sees = !kIsShared || (tables.item.sharers >> lane & 1) != 0;
    ModelView<float> of_sharer;
    if (kIsShared && sees) of_sharer = sharers[lane].view;
    const ModelView<float>& view = kIsShared ? of_sharer : tables.placement.view;
    bool is_faint = false;
    if constexpr (Source::kTints)
        if (sees) is_faint = factors[kIsShared ? lane : 0].opacity < 1;
    const auto reach_scale_of = [&] {
        const float* linear = view.linear;
        return camera_as<C>(tables).sphere_scale(
            tables.limits, linear[6] * linear[6] + linear[7] * linear[7] + linear[8] * linear[8]);
    };
    const float reach_scale = sees ? reach_scale_of() : 0;
    unsigned head = 0, waiting = 0;
    uint32_t record = tables.item.record;  // index of the next record to write
    ItemTraits traits{.are_small = false, .have_shade = Source::has_shade(tables.model)};
    bool are_tested = true;
    const typename Source::Place start = Source::start(tables);
    typename Source::Place here = start;
    typename Source::Fetched next_fetched{};
    if ((kIsShared ? 0 : lane) < count)
        next_fetched = Source::fetch(tables.model, tables.item.first + (kIsShared ? 0 : lane));
    for (unsigned first = 0; first < count || waiting > 0; first += kRound) {
        const typename Source::Fetched fetched = next_fetched;
        const unsigned place = kIsShared ? first : first + lane;
        if (place + kRound < count)
            next_fetched = Source::fetch(tables.model, tables.item.first + place + kRound);
        bool may_reach = false, is_small = false;
        Queued mine{.p = {}, .place = kIsShared ? 32 * place + lane : place};
        if (place < count && sees) {
            const float4 sphere =
                Source::sphere(tables.model, here, tables.item.first + place, fetched);
            const float mean[3] = {sphere.x, sphere.y, sphere.z};
            to_view(view, mean, mine.p);
            if (are_tested) {
                const SphereTest told =
                    test_sphere<Source, C>(tables, mine.p, sphere.w, reach_scale, is_faint);
                may_reach = told.may_reach;
                is_small = may_reach && told.half < kSmall;
                num_in_frustum += told.misses_centers;
            } else {
                const C& cam = camera_as<C>(tables);
                may_reach = cam.depth_of(mine.p) >= cam.near_depth && !(sphere.w < 0);
            }
        }
        if (are_tested) {
            if (first == 0)
                traits.are_small = __popc(__ballot_sync(kAllLanes, is_small)) >= kManySmall;
            const unsigned come = __ballot_sync(kAllLanes, may_reach);
            if (may_reach)
                space.queue[(head + waiting + __popc(come & ((1u << lane) - 1))) % kQueue] = mine;
            waiting += __popc(come);
            __syncwarp();
            const bool are_nearly_all = !kIsShared && __popc(come) >= kNearlyAll;
            if (waiting < 32 && first + kRound < count && !are_nearly_all) continue;
            // After the last gaussian, more than 32 gaussians may be left in the queue.
            // They are projected in the next iterations.
            const unsigned taken = min(waiting, 32u);
            may_reach = lane < taken;
            if (may_reach) mine = space.queue[(head + lane) % kQueue];
            head += taken;
            waiting -= taken;
            are_tested = !are_nearly_all || waiting > 0;
        }
        const unsigned num_records =
            write_records<Source, kIsShared, C>(space, sharers, factors, start, traits, may_reach,
                                                mine, record, counters, out, num_in_frustum);
        record += num_records;
        are_tested = are_tested || num_records < kMany;
        __syncwarp();  // the next iteration overwrites the queue and the records
    }
    write_large(space, counters, out, true);
    return record - tables.item.record;
}

template <class Model>
__device__ void report_item(const ItemTables<Model>& tables, unsigned item, unsigned num_records,
                            const ProjectOutput& out) {
    if (threadIdx.x % 32 != 0) return;
    out.item_records[item] = num_records;
    out.item_tiles[item] = {.num_records = num_records,
                            .record = tables.item.record,
                            .first_tile = tables.image.first_tile,
                            .columns = static_cast<uint32_t>(tables.image.tile_columns)};
}

// Adds the counts of an item to the counts of its image. `num_in_frustum` is the number
// that this lane has counted. All lanes of the warp must call it.
template <class Model>
__device__ void report_image(const ItemTables<Model>& tables, unsigned num_in_frustum,
                             ImageCounts* image_counts) {
    num_in_frustum = warp_sum(num_in_frustum);
    if (threadIdx.x % 32 != 0) return;
    const unsigned num_instances = max(__popc(tables.item.sharers), 1);
    ImageCounts& counts = image_counts[tables.placement.image];
    atomicAdd(&counts.gaussians,
              static_cast<unsigned long long>(num_instances * tables.item.count));
    if (num_in_frustum > 0)
        atomicAdd(&counts.in_frustum, static_cast<unsigned long long>(num_in_frustum));
}

__device__ void report_counts(FrameCounters& counters, unsigned num_in_frustum,
                              unsigned num_records) {
    num_in_frustum = warp_sum(num_in_frustum);
    // Without gaussians in the frustum there are no records.
    if (threadIdx.x % 32 != 0 || num_in_frustum == 0) return;
    atomicAdd(&counters.in_frustum, static_cast<unsigned long long>(num_in_frustum));
    atomicAdd(&counters.records, static_cast<unsigned long long>(num_records));
}

template <class Source>
__device__ const InstanceFactors* factors_for(const ProjectInput& in, const DrawItem& item) {
    if constexpr (Source::kTints)
        return in.factors_of(item);
    else
        return nullptr;
}

template <class Source, class C>
__global__ void __launch_bounds__(32 * kWarps, kBlocks)
    project_kernel(ProjectInput in, const typename Source::Model* models, ProjectOutput out,
                   unsigned* taken) {
    await_kernel_before();
    if (!in.items.is_complete()) return;
    __shared__ WarpSpace<typename Source::Model> spaces[kWarps];
    WarpSpace<typename Source::Model>& space = spaces[threadIdx.x / 32];
    const unsigned num_items = static_cast<unsigned>(in.items.counters->items);
    unsigned num_in_frustum = 0, num_records = 0;
    Loaded loaded;
    Source::prepare();
    space.tiles.count = 0;
    // A warp without an item skips the loop, and reads the tile queue immediately.
    __syncwarp();
    // The number of visible gaussians per item varies widely, so warps claim items from
    // a counter. A warp claims its next item when it starts the current one, which
    // hides the latency of the atomic operation.
    for (unsigned i = blockIdx.x * kWarps + threadIdx.x / 32; i < num_items;) {
        const uint32_t item_word = load_word(in.items.items[i]);
        const unsigned next = take_next(taken, gridDim.x * kWarps);
        const uint32_t placement_word =
            load_word(in.placements[__shfl_sync(kAllLanes, item_word, 0)]);
        __syncwarp();
        store_tables(space.tables, item_word, placement_word, in, models, loaded);
        if (space.tables.item.sharers == 0 && Source::has(space.tables.model)) {
            const unsigned before = num_in_frustum;
            const unsigned written = project_item<Source, false, C>(
                space, nullptr, factors_for<Source>(in, space.tables.item), *in.items.counters, out,
                num_in_frustum);
            num_records += written;
            report_item(space.tables, i, written, out);
            if (in.image_counts != nullptr)
                report_image(space.tables, num_in_frustum - before, in.image_counts);
        }
        i = __shfl_sync(kAllLanes, next, 0);
    }
    count_waiting(out.tiles.count, space.tiles);
    report_counts(*in.items.counters, num_in_frustum, num_records);
}

// Most frames have few shared items, so a warp examines 32 items at once to find them.
template <class Source, class C>
__global__ void __launch_bounds__(32 * kWarps, kBlocks)
    project_shared_kernel(ProjectInput in, const typename Source::Model* models,
                          ProjectOutput out) {
    await_kernel_before();
    if (!in.items.is_complete()) return;
    __shared__ WarpSpace<typename Source::Model> spaces[kWarps];
    WarpSpace<typename Source::Model>& space = spaces[threadIdx.x / 32];
    const unsigned num_items = static_cast<unsigned>(in.items.counters->items),
                   stride = gridDim.x * kWarps;
    unsigned num_in_frustum = 0, num_records = 0;
    Loaded loaded;
    Source::prepare();
    space.tiles.count = 0;
    // A warp without an item skips the loop, and reads the tile queue immediately.
    __syncwarp();
    for (unsigned first = blockIdx.x * kWarps + threadIdx.x / 32; first < num_items;
         first += 32 * stride) {
        const unsigned mine = first + threadIdx.x % 32 * stride;
        unsigned todo =
            __ballot_sync(kAllLanes, mine < num_items && in.items.items[mine].sharers != 0);
        for (; todo != 0; todo &= todo - 1) {
            const unsigned i = first + (__ffs(todo) - 1) * stride;
            const DrawItem& item = in.items.items[i];
            const Placement* sharers = in.placements + item.placement;
            __syncwarp();
            store_tables(space.tables, load_word(item), load_word(sharers[__ffs(item.sharers) - 1]),
                         in, models, loaded);
            if (!Source::has(space.tables.model)) continue;
            const unsigned before = num_in_frustum;
            const unsigned written =
                project_item<Source, true, C>(space, sharers, factors_for<Source>(in, item),
                                              *in.items.counters, out, num_in_frustum);
            num_records += written;
            report_item(space.tables, i, written, out);
            if (in.image_counts != nullptr)
                report_image(space.tables, num_in_frustum - before, in.image_counts);
        }
    }
    count_waiting(out.tiles.count, space.tiles);
    report_counts(*in.items.counters, num_in_frustum, num_records);
}

}  // namespace

// Launches the kernel for shared items.
template <class Source, class C>
static void project_shared(const typename Source::Model* models, const ProjectInput& in,
                           const ProjectOutput& out, unsigned blocks, cudaStream_t stream) {
    launch_early("project_shared_kernel", project_shared_kernel<Source, C>, blocks, 32 * kWarps, 0,
                 stream, in, models, out);
}

// Launches the kernels for one source. `SharedSource` reads the models of shared items.
// It does not support fades, because shared items have weight 1.
template <class Source, class SharedSource, class C = Pinhole<float>>
static void project_from(const typename Source::Model* models, const ProjectInput& in,
                         const ProjectOutput& out, int taken, cudaStream_t stream) {
    const unsigned blocks = kBlocks * num_multiprocessors();
    launch_early("project_kernel", project_kernel<Source, C>, blocks, 32 * kWarps, 0, stream, in,
                 models, out, out.taken + taken);
    if (in.has_shared_items && out.source != nullptr)
        project_shared<Placing<SharedSource>, C>(models, in, out, blocks, stream);
    else if (in.has_shared_items)
        project_shared<SharedSource, C>(models, in, out, blocks, stream);
}

template <class Source>
static void project_instances(const typename Source::Model* models, const ProjectInput& in,
                              const ProjectOutput& out, int taken, cudaStream_t stream) {
    if (in.has_faded_items)
        project_from<Faded<Source>, Source>(models, in, out, taken, stream);
    else
        project_from<Source, Source>(models, in, out, taken, stream);
}

template <class Source>
static void project_scene(const typename Source::Model* models, const ProjectInput& in,
                          const ProjectOutput& out, int taken, cudaStream_t stream) {
    // Frames with lenses use fewer kernels: those for fades also draw items that are
    // not faded, whose weight is 1.
    if (in.has_lenses && in.factors != nullptr)
        project_from<Faded<Tinted<Source>>, Tinted<Source>, Intrinsics<float>>(models, in, out,
                                                                               taken, stream);
    else if (in.has_lenses)
        project_from<Faded<Source>, Source, Intrinsics<float>>(models, in, out, taken, stream);
    else if (in.factors != nullptr)
        project_instances<Tinted<Source>>(models, in, out, taken, stream);
    else
        project_instances<Source>(models, in, out, taken, stream);
}

void project(const ProjectInput& in, const ProjectOutput& out, cudaStream_t stream) {
    if (in.packed != nullptr) project_scene<PackedSource>(in.packed, in, out, 0, stream);
    if (in.coded != nullptr) project_scene<CodeSource>(in.coded, in, out, 1, stream);
    if (in.packed != nullptr || in.coded != nullptr) return;
    if (in.has_lenses)
        project_from<RowSource, RowSource, Intrinsics<float>>(in.models, in, out, 0, stream);
    else
        project_from<RowSource, RowSource>(in.models, in, out, 0, stream);
}

}  // namespace cuda
}  // namespace v3dg
