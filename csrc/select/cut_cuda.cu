// A cut takes two kernels. place_kernel, a thread an instance: the camera in its frame, and where
// its cut is found: nowhere, among its tops, or in its table. That is dealt out as parts: 256 of
// the clusters of a table that its distance leaves to be asked; or, of up to 32 neighbouring
// instances, the tops or, where that leaves no more than a lane asks, the last of each. cut_kernel,
// a block up to eight parts, of which a warp has one: which clusters are drawn, and their places in
// the list by a prefix sum.
//
// For a budget, the kernels of budget_cuda.cu run in between, for two rounds with place_kernel
// before each.

#include "select/select_cuda.h"

#include <algorithm>

#include "base/device_guard.h"
#include "base/scan.cuh"
#include "select/cut_parts.cuh"
#include "select/draw_items.cuh"

namespace v3dg {
namespace cuda {

// Where the choice of a budget goes, and what a frame wants besides: nulls where there is none.
struct Cut::Target {
    EyeImages pictures;
    FrameImage* images;
    Placement* placements;
    CutChoice* choice;
};

namespace {

constexpr unsigned kCutBlocks = 4;  // on a multiprocessor
constexpr unsigned kReportBlocks = 64;
constexpr unsigned kPlaceBlocks = 12;  // on a multiprocessor
constexpr unsigned kFewBundles = 8;
constexpr unsigned kPlaceThreads =
    64;  // few, so that a few thousand instances spread over the device
constexpr unsigned kFewInstances = 8192, kFewLanes = 8;  // and so do their parts

// The sides of the frustum for each bundle, which every instance would take eight divisions of
// doubles to find out: as an argument where there are few bundles, in memory where there are more.
struct BundleSides {
    CameraSides few[kFewBundles];
    const CameraSides* many;  // null where there are few

    __device__ CameraSides operator[](size_t bundle) const {
        if (many != nullptr) return many[bundle];
        return few[bundle];
    }
};

// Scratch of one round of a cut: zeros, but for the states of cut_kernel, which place_kernel
// clears.
struct Scratch {
    unsigned *place_ticket, *cut_ticket;
    unsigned* num_parts;
    Count* place_state;               // a word a block of place_kernel
    Count *unit_state, *count_state;  // a word a ticket of cut_kernel
    unsigned num_places;              // blocks of cut_kernel that there is room for at once

    // Parts that a block takes together: as many as it has warps, or fewer where that spreads them
    // over all places, because warps without a part help the others to ask.
    __device__ unsigned parts_at_once(unsigned parts) const {
        return min(max(blocks_for(parts, num_places), 1u), kCutWarps);
    }
};

// Of an instance's model in front of an eye; of n instances, that of instance i is placement eye *
// n + i.
__device__ Placement placement_of(const InstanceAxes& axes, const Pose& pose, int32_t bundle,
                                  unsigned eye) {
    return {model_view_from_instance(axes, pose), static_cast<uint32_t>(bundle), eye};
}

// A record of each lane of a warp, on its way between registers and memory.
template <class Record>
struct RecordRow {
    Record* records;

    __device__ void set(const Record& mine) const { records[threadIdx.x % 32] = mine; }
    // Writes those of the lanes that have one to their places, which follow each other from `first`
    // on, as whole rows of memory; for whole warps.
    __device__ void write(bool has_one, Record* first) const {
        constexpr unsigned kVectors = sizeof(Record) / sizeof(uint4);
        static_assert(sizeof(Record) % sizeof(uint4) == 0 && alignof(Record) % sizeof(uint4) == 0,
                      "records are whole vectors");
        const unsigned writers = __ballot_sync(kAllLanes, has_one);
        __syncwarp();
        if (writers == 0) return;
        const auto* from = reinterpret_cast<const uint4*>(records);
        auto* to = reinterpret_cast<uint4*>(first);
#pragma unroll
        for (unsigned k = 0; k < kVectors; ++k) {
            const unsigned v = 32 * k + threadIdx.x % 32;
            if (writers >> v / kVectors & 1) to[v] = from[v];
        }
        __syncwarp();  // before the next records are set
    }
};

// Where the cut of an instance is found, and which clusters are asked where that is a table.
// `is_alone`: by one lane.
struct Placed {
    CutSource source;
    ClusterRange asked;
    bool is_alone;
};

// Places instance i, if there is one. Writes what the kernels after this one need of it. For whole
// warps, of neighbours.
__device__ Placed place_instance(const PlacedScene& scene, size_t i, const Eyes& eyes,
                                 const BundleSides& sides, const SelectRule& rule,
                                 Placement* placements) {
    __shared__ InstanceView space[kPlaceThreads];
    static_assert(sizeof(Placement) <= sizeof(InstanceView), "rows of both take turns");
    InstanceView* of_warp = space + threadIdx.x / 32 * 32;
    const RecordRow<Placement> placement_row{reinterpret_cast<Placement*>(of_warp)};
    const RecordRow<InstanceView> view_row{of_warp};
    const size_t num_instances = scene.instances.scale.size, first = i - threadIdx.x % 32;
    const Pose pose = i < num_instances ? scene.instances.pose(i) : Pose{nullptr, nullptr, 0.0};
    CutSource source = CutSource::nowhere;
    ClusterRange asked{0, 0};
    bool is_alone = false;
    int32_t bundle = 0;
    InstanceView view;
    if (i < num_instances && is_placed(pose)) {
        bundle = scene.instances.bundle[i];
        const ClusterTable& table = scene.bundles[bundle].table;
        {
            const InstanceAxes axes = axes_of_instance(eyes.camera[0], pose);
            view =
                view_from_instance(eyes, sides[bundle], axes, pose, scene.instances.importance[i]);
            // Before it is known whether it is seen, so that the axes need not be kept until then.
            if (placements != nullptr) placement_row.set(placement_of(axes, pose, bundle, 0));
        }
        source = source_of_cut(table, view, rule, kLaneClusters);
        if (source == CutSource::tops) {
            const InstanceCut<AskedGroups> cut{table, view, rule, {table, view, rule}, rule.culls};
            unsigned drawn = 0;
            for (unsigned k = 0; k < table.top_cluster.size; ++k)
                if (!cut.is_culled(table.top_cluster[k])) drawn |= 1u << k;
            scene.tops[i] = static_cast<uint8_t>(drawn);
            if (drawn == 0) source = CutSource::nowhere;
        }
        // A budget's tolerance is not known yet.
        if (source == CutSource::table) {
            asked = clusters_to_ask(
                table, scene.bundles[bundle].runs, view, rule,
                rule.budget == kNoBudget ? Tolerances::this_one : Tolerances::from_this_on);
            is_alone = asked.first < asked.end && asked.first >= last_of_table(table);
            if (is_alone) scene.tops[i] = 0;
        }
        is_alone |= source == CutSource::tops;
    }
    const bool is_seen = source != CutSource::nowhere;
    if (placements != nullptr) {
        placement_row.write(is_seen, placements + first);
        if (eyes.are_two) {
            if (is_seen)
                placement_row.set(
                    placement_of(axes_of_instance(eyes.camera[1], pose), pose, bundle, 1));
            placement_row.write(is_seen, placements + num_instances + first);
        }
    }
    if (source == CutSource::table) view_row.set(view);
    view_row.write(source == CutSource::table, scene.views + first);
    return {source, asked, is_alone};
}

// A thread a bundle.
__global__ void sides_kernel(const BundleOnDevice* bundles, size_t num_bundles, Eyes eyes,
                             CameraSides* sides) {
    const size_t b = size_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (b < num_bundles) sides[b] = sides_of_eyes(eyes, bundles[b].table.pad_px);
}

// `kAreTwo`: whether the eyes are.
template <bool kAreTwo>
__global__ void __launch_bounds__(kPlaceThreads, kAreTwo ? kPlaceBlocks / 2 : kPlaceBlocks)
    place_kernel(PlacedScene scene, Eyes eyes, BundleSides sides, SelectRule rule,
                 EyeImages pictures, FrameImage* images, Placement* placements, BudgetRound round,
                 Scratch scratch) {
    if (round.is_over()) return;
    eyes.are_two = kAreTwo;
    rule.tolerance_px2 = round.least_tolerance(rule);
    const size_t block = take_ticket(scratch.place_ticket), i = block * kPlaceThreads + threadIdx.x;
    if (i < pictures.count) images[i] = pictures.image[i];
    const auto [source, asked, is_alone] = place_instance(scene, i, eyes, sides, rule, placements);

    // Neighbours with a lane of their own and no other table in between make one part, which the
    // first of them writes.
    const unsigned lane = threadIdx.x % 32, below = (1u << lane) - 1;
    const unsigned lanes = __ballot_sync(kAllLanes, is_alone);
    const unsigned tables = __ballot_sync(kAllLanes, source == CutSource::table && !is_alone);
    const unsigned table_below = tables & below, table_above = tables & ~below;
    const unsigned width = scene.instances.scale.size <= kFewInstances ? kFewLanes : 32;
    const unsigned first = lane / width * width;
    const unsigned from =
        max(first, table_below != 0 ? 32 - __clz(static_cast<int>(table_below)) : 0);
    const unsigned to = min(first + width, table_above != 0 ? __ffs(table_above) - 1 : 32);
    const bool begins = is_alone && (lanes & below) >> from == 0;
    const unsigned parts = is_alone ? begins : blocks_for(asked.end - asked.first, kPartSize);

    unsigned total;
    const unsigned before_in_block = block_prefix(parts, total);
    __shared__ unsigned before_block;
    if (threadIdx.x < 32) {
        const unsigned before =
            static_cast<unsigned>(prefix_of_part(scratch.place_state, block, total));
        if (threadIdx.x == 0) before_block = before;
    }
    __syncthreads();
    const unsigned before = before_block;
    CutPart* part = scene.parts + before + before_in_block;
    if (begins) {
        const unsigned until = to < 32 ? (1u << to) - 1 : kAllLanes;
        *part = {static_cast<uint32_t>(i), 0, (lanes & until) >> lane};
    } else if (!is_alone) {
        for (unsigned p = 0; p < parts; ++p)
            part[p] = {static_cast<uint32_t>(i), asked.first + p * kPartSize, 0};
    }
    // Cleared are as many tickets as there are places, and those whose first part is one of the
    // block's own where tickets have kCutWarps parts.
    const auto clear = [&](unsigned first, unsigned end, unsigned step) {
        for (unsigned t = first; t < end; t += step)
            scratch.unit_state[t] = scratch.count_state[t] = 0;
    };
    clear(static_cast<unsigned>(i), scratch.num_places, gridDim.x * kPlaceThreads);
    clear(blocks_for(before, kCutWarps) + threadIdx.x, blocks_for(before + total, kCutWarps),
          kPlaceThreads);
    if (block + 1 == gridDim.x && threadIdx.x == 0) *scratch.num_parts = before + total;
}

// Writes what a block adds to a list: each thread the clusters that it draws. The blocks' parts of
// the list are in the order of their tickets.
template <class Output>
__device__ void write_clusters(const LaneClusters& mine, unsigned ticket, bool is_last,
                               Count* unit_state, Count* count_state, const Output& output) {
    __shared__ Count before_units, before_gaussians;
    const WriteCount count = output.count(mine);
    // Both numbers in one word: an item has up to 256 gaussians, so that the 28 bits of units last
    // as long as the 36 of gaussians. What is beyond those is lost, but never counts as a unit.
    constexpr unsigned kUnitBits = 28, kUnits = (1u << kUnitBits) - 1;
    Count in_block;
    const Count before_in_block =
        block_prefix(Count{count.gaussians} << kUnitBits | count.units, in_block);
    const Count num_units = in_block & kUnits, num_gaussians = in_block >> kUnitBits;
    if (threadIdx.x < 64) {  // a warp each
        const bool is_units = threadIdx.x < 32;
        const Count before = prefix_of_part(is_units ? unit_state : count_state, ticket,
                                            is_units ? num_units : num_gaussians);
        if (threadIdx.x % 32 == 0) (is_units ? before_units : before_gaussians) = before;
    }
    __syncthreads();
    output.write(mine, before_units + (before_in_block & kUnits),
                 before_gaussians + (before_in_block >> kUnitBits));
    if (is_last && threadIdx.x == 0)
        output.finish(before_units + num_units, before_gaussians + num_gaussians);
}

// Tells which page the cluster of an instance needs.
__device__ void tell_need(const InstanceCut<AskedGroups>& cut, int32_t c, uint32_t bundle,
                          const NeedList& needs) {
    if (cut.table.pages.is_whole()) return;
    const PageNeed need = page_need(cut.table, c, [&](int32_t g) {
        return priority_of(wanted_metric_px2(cut.table, g, cut.view, cut.rule), cut.rule);
    });
    if (need.page < 0 || cut.is_culled(c)) return;
    uint32_t* word = needs.need[bundle] + need.page;
    const uint32_t bits =
        __float_as_uint(need.priority);  // of a positive float, so they order as it does
    if (*static_cast<volatile uint32_t*>(word) >= bits || atomicMax(word, bits) != 0) return;
    const unsigned place = atomicAdd(needs.words, 1u);
    if (place < needs.capacity)
        needs.list[place] = {bundle, static_cast<uint32_t>(need.page), 0.0f};
}

// A thread a page that is needed. A warp writes words that lie side by side, for what goes to the
// host piece by piece is slow.
__global__ void report_kernel(NeedList needs, SelectRule rule, const CutChoice* choice) {
    constexpr unsigned kWords = sizeof(PageRequest) / sizeof(uint32_t);
    __shared__ uint32_t words[kWords * kCutThreads];
    const unsigned num_pages = *needs.words, count = min(num_pages, needs.capacity);
    if (blockIdx.x == 0 && threadIdx.x == 0)
        *needs.report = {num_pages,
                         rule.budget == kNoBudget ? rule.tolerance_px2 : choice->tolerance_px2};
    for (unsigned first = blockIdx.x * kCutThreads; first < count;
         first += gridDim.x * kCutThreads) {
        const unsigned here = min(count - first, kCutThreads);
        if (threadIdx.x < here) {
            const PageRequest need = needs.list[first + threadIdx.x];
            uint32_t* own = words + kWords * threadIdx.x;
            own[0] = need.bundle;
            own[1] = need.page;
            own[2] = needs.need[need.bundle][need.page];
        }
        __syncthreads();
        auto* reported = reinterpret_cast<uint32_t*>(needs.reported + first);
        for (unsigned i = threadIdx.x; i < kWords * here; i += kCutThreads) reported[i] = words[i];
        __syncthreads();
    }
}

template <class Output, bool kTells>
__global__ void __launch_bounds__(kCutThreads, kCutBlocks)
    cut_kernel(PlacedScene scene, SelectRule rule, const CutChoice* choice,
               const BudgetState* state, Scratch scratch, Scratch second_scratch, NeedList needs,
               Output output) {
    await_kernel_before();
    if (state != nullptr && state->again != 0) scratch = second_scratch;
    const unsigned num_parts = *scratch.num_parts, at_once = scratch.parts_at_once(num_parts);
    const unsigned num_tickets = blocks_for(num_parts, at_once);
    if (num_tickets == 0 && blockIdx.x == 0 && threadIdx.x == 0) output.finish(0, 0);
    if (rule.budget != kNoBudget) rule.tolerance_px2 = choice->tolerance_px2;
    if (!Output::kFades) rule.fade = {};
    // Where there is a block for each ticket, a block takes one, and the others none.
    const bool is_enough = num_tickets <= gridDim.x;
    if (is_enough && blockIdx.x >= num_tickets) return;
    for (unsigned ticket = take_ticket(scratch.cut_ticket); ticket < num_tickets;
         ticket = is_enough ? num_tickets : take_ticket(scratch.cut_ticket)) {
        const unsigned warp = threadIdx.x / 32, p = ticket * at_once + warp;
        LaneClusters mine{};
        if (warp < at_once && p < num_parts) mine = clusters_of_lane(scene, scene.parts[p]);
        const auto weigh = [&](const BundleOnDevice& bundle, const InstanceView& view, int32_t c) {
            const ClusterTable& table = bundle.table;
            const InstanceCut<AskedGroups> cut{table, view, rule, {table, view, rule}, rule.culls};
            if constexpr (kTells)
                tell_need(cut, c, static_cast<uint32_t>(&bundle - scene.bundles), needs);
            return cut.drawn_weight(c);
        };
        ask_clusters<Output::kFades>(scene, rule, Tolerances::this_one, mine, weigh);
        write_clusters(mine, ticket, ticket + 1 == num_tickets, scratch.unit_state,
                       scratch.count_state, output);
    }
}

// A thread an instance.
__global__ void place_all_kernel(PlacedScene scene, Camera camera, FrameImage image,
                                 FrameImage* images, Placement* placements) {
    const size_t i = size_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i == 0) images[0] = image;
    if (i >= scene.instances.scale.size) return;
    const Pose pose = scene.instances.pose(i);
    placements[i] =
        placement_of(axes_of_instance(camera, pose), pose, scene.instances.bundle[i], 0);
}

// A thread a pair. The pairs of instances without a pose are left out.
template <class Output>
__global__ void __launch_bounds__(kCutThreads)
    given_kernel(PlacedScene scene, GivenCut given, Scratch scratch, Output output) {
    const unsigned ticket = take_ticket(scratch.cut_ticket);
    const size_t p = size_t(ticket) * kCutThreads + threadIdx.x;
    LaneClusters mine{};
    if (p < given.instance.size && is_placed(scene.instances.pose(given.instance[p]))) {
        const int32_t i = given.instance[p];
        mine = {&scene.bundles[scene.instances.bundle[i]],
                static_cast<uint32_t>(i),
                static_cast<uint32_t>(given.cluster[p]),
                false,
                false,
                1,
                {}};
        if (Output::kFades)
            mine.weights =
                LaneWeights::all(static_cast<int32_t>(given.weight_of(p) * kWhole + 0.5f));
    }
    write_clusters(mine, ticket, ticket + 1 == gridDim.x, scratch.unit_state, scratch.count_state,
                   output);
}

// At least one: an empty scene has a picture, too.
unsigned place_blocks(size_t num_instances) {
    return std::max(1u, blocks_for(num_instances, kPlaceThreads));
}

// Zeros of a Scratch: three counters and the states of place_kernel's blocks.
size_t zeros_of_round(size_t num_instances) { return 2 + place_blocks(num_instances); }

// `states`: two words a ticket.
Scratch scratch_in(Count* zeros, Count* states, size_t num_tickets, unsigned num_places) {
    auto* counters = reinterpret_cast<unsigned*>(zeros);
    return {counters, counters + 1,         counters + 2, zeros + 2,
            states,   states + num_tickets, num_places};
}

// Parts of all tables together, if every one is asked.
size_t most_parts(const SceneTables& scene) {
    size_t parts = 0;
    for (size_t b = 0; b < scene.num_bundles(); ++b)
        parts += scene.num_instances_of(b) *
                 std::max(1u, blocks_for(scene.bundle(b).num_clusters(), kPartSize));
    return parts;
}

template <class T>
void copy_to_host(T* to, const T* from, size_t count, cudaStream_t stream) {
    if (count > 0)
        check(cudaMemcpyAsync(to, from, count * sizeof(T), cudaMemcpyDeviceToHost, stream),
              "cudaMemcpyAsync to the host");
}

}  // namespace

BudgetState* Cut::budget_state(cudaStream_t stream) {
    const BudgetState none{};
    if (budget_.data() == nullptr) budget_.copy_from({&none, 1}, stream);
    return budget_.data();
}

size_t Cut::num_zeros(const SceneTables& scene, const SelectRule& rule) {
    const size_t of_round = zeros_of_round(scene.num_instances());
    return rule.budget == kNoBudget ? of_round : 2 * of_round + kNumBudgetBins;
}

template <class Output>
void Cut::cut(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
              const Target& target, const Output& output, Count* zeros, cudaStream_t stream,
              const PartlyResident* resident) {
    const size_t count = scene.num_instances(), parts = most_parts(scene);
    const unsigned num_places = kCutBlocks * num_multiprocessors();
    const size_t num_tickets = std::max<size_t>(blocks_for(parts, kCutWarps), num_places);
    Count* states = states_.reserve(4 * num_tickets, stream);
    const Scratch scratches[2] = {scratch_in(zeros, states, num_tickets, num_places),
                                  scratch_in(zeros + zeros_of_round(count),
                                             states + 2 * num_tickets, num_tickets, num_places)};
    const SceneOnDevice on_device = scene.on_device();
    const PlacedScene placed{resident == nullptr ? on_device.bundles : resident->bundles,
                             on_device.instances, views_.reserve(count, stream),
                             tops_.reserve(count, stream), parts_.reserve(parts, stream)};
    const auto blocks = static_cast<unsigned>(std::clamp<size_t>(parts, 1, 2 * num_places));
    const bool has_budget = rule.budget != kNoBudget;
    Count* change = zeros + 2 * zeros_of_round(count);  // with a budget
    BudgetState* state = has_budget ? budget_state(stream) : nullptr;
    BundleSides sides{};
    const size_t num_bundles = scene.num_bundles();
    if (num_bundles > kFewBundles) {
        CameraSides* many = sides_.reserve(num_bundles, stream);
        launch("sides_kernel", sides_kernel, blocks_for(num_bundles, kCutThreads), kCutThreads, 0,
               stream, placed.bundles, num_bundles, eyes, many);
        sides.many = many;
    } else {
        for (size_t b = 0; b < num_bundles; ++b)
            sides.few[b] = sides_of_eyes(eyes, scene.bundle(b).on_device().table.pad_px);
    }
    for (const bool is_second : {false, true}) {
        const Scratch& scratch = scratches[is_second];
        const BudgetRound round{state, is_second};
        launch("place_kernel", eyes.are_two ? place_kernel<true> : place_kernel<false>,
               place_blocks(count), kPlaceThreads, 0, stream, placed, eyes, sides, rule,
               target.pictures, target.images, target.placements, round, scratch);
        if (!has_budget) break;
        choose_tolerance(placed, rule, round, blocks, scratch.num_parts, change, target.choice,
                         state, stream);
    }
    const NeedList needs = resident == nullptr ? NeedList{} : resident->needs;
    if (needs.report == nullptr) {
        launch_early("cut_kernel", cut_kernel<Output, false>, blocks, kCutThreads, 0, stream,
                     placed, rule, target.choice, state, scratches[0], scratches[1], needs, output);
        return;
    }
    check(cudaMemsetAsync(needs.words, 0, needs.num_words * sizeof(uint32_t), stream),
          "cudaMemsetAsync");
    launch_early("cut_kernel", cut_kernel<Output, true>, blocks, kCutThreads, 0, stream, placed,
                 rule, target.choice, state, scratches[0], scratches[1], needs, output);
    launch("report_kernel", report_kernel, kReportBlocks, kCutThreads, 0, stream, needs, rule,
           target.choice);
}

void Cut::cut_items(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                    const EyeImages& pictures, FrameImage* images, Placement* placements,
                    const ItemList& items, cudaStream_t stream, const PartlyResident* resident) {
    const DeviceGuard guard(device_);
    const StreamLock lock = scene.lock(stream);
    const Target target{pictures, images, placements, &items.counters->choice};
    const auto num_instances = static_cast<uint32_t>(scene.num_instances());
    if (rule.fade.is_on())
        cut(scene, eyes, rule, target, ItemOutput<true>{items, pictures.count, num_instances},
            items.zeros, stream, resident);
    else
        cut(scene, eyes, rule, target, ItemOutput<false>{items, pictures.count, num_instances},
            items.zeros, stream, resident);
}

void Cut::given_items(const SceneTables& scene, const Camera& camera, const GivenCut& given,
                      const FrameImage& image, FrameImage* images, Placement* placements,
                      const ItemList& items, cudaStream_t stream) {
    const DeviceGuard guard(device_);
    const StreamLock lock = scene.lock(stream);
    const SceneOnDevice on_device = scene.on_device();
    const PlacedScene placed{on_device.bundles, on_device.instances, nullptr, nullptr, nullptr};
    const unsigned blocks = std::max(1u, blocks_for(given.instance.size, kCutThreads));
    const size_t num_zeros = zeros_of_round(0), words = num_zeros + 2 * size_t(blocks);
    Count* zeros = states_.reserve(words, stream);
    const Scratch scratch = scratch_in(zeros, zeros + num_zeros, blocks, blocks);
    check(cudaMemsetAsync(zeros, 0, words * sizeof(Count), stream), "cudaMemsetAsync");
    launch("place_all_kernel", place_all_kernel, place_blocks(scene.num_instances()), kPlaceThreads,
           0, stream, placed, camera, image, images, placements);
    if (given.weight.size > 0)
        launch("given_kernel", given_kernel<ItemOutput<true>>, blocks, kCutThreads, 0, stream,
               placed, given, scratch, ItemOutput<true>{items, 1, 0});
    else
        launch("given_kernel", given_kernel<ItemOutput<false>>, blocks, kCutThreads, 0, stream,
               placed, given, scratch, ItemOutput<false>{items, 1, 0});
}

template <bool kFades>
void Cut::select_pairs(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                       SelectOutput& out, cudaStream_t stream, const PartlyResident* resident,
                       uint32_t* last_bin) {
    const DeviceGuard guard(device_);
    const StreamLock lock = scene.lock(stream);
    Pairs* on_device = pairs_.reserve(1, stream);
    const size_t num_words = num_zeros(scene, rule);
    Count* zeros = zeros_.reserve(num_words, stream);
    Pairs counts{};
    const bool has_budget = rule.budget != kNoBudget;
    const bool keeps_bin = has_budget && last_bin != nullptr;
    uint32_t* bin_on_device = keeps_bin ? &budget_state(stream)->last_bin : nullptr;
    // Most cuts of most scenes fit at once.
    for (Count capacity = std::max<Count>(1u << 16, pair_instance_.capacity());;
         capacity = counts.pairs) {
        const PairOutput<kFades> output{pair_instance_.reserve(capacity, stream),
                                        pair_cluster_.reserve(capacity, stream),
                                        kFades ? pair_weight_.reserve(capacity, stream) : nullptr,
                                        capacity,
                                        &on_device->pairs,
                                        &on_device->gaussians};
        check(cudaMemsetAsync(on_device, 0, sizeof *on_device, stream), "cudaMemsetAsync");
        check(cudaMemsetAsync(zeros, 0, num_words * sizeof(Count), stream), "cudaMemsetAsync");
        if (keeps_bin)
            check(cudaMemcpyAsync(bin_on_device, last_bin, sizeof *last_bin, cudaMemcpyHostToDevice,
                                  stream),
                  "cudaMemcpyAsync of the last bin");
        cut(scene, eyes, rule, {{}, nullptr, nullptr, &on_device->choice}, output, zeros, stream,
            resident);
        copy_to_host(&counts, on_device, 1, stream);
        check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
        if (counts.pairs <= capacity) break;
    }
    out.fits_budget = !has_budget || !counts.choice.exceeds_budget;
    out.tolerance_px2 = has_budget ? counts.choice.tolerance_px2 : rule.tolerance_px2;
    out.num_gaussians =
        static_cast<int64_t>(out.fits_budget ? counts.gaussians : counts.choice.least);
    out.instance.resize(counts.pairs);
    out.cluster.resize(counts.pairs);
    out.weight.resize(kFades ? counts.pairs : 0);
    copy_to_host(out.instance.data(), pair_instance_.data(), counts.pairs, stream);
    copy_to_host(out.cluster.data(), pair_cluster_.data(), counts.pairs, stream);
    copy_to_host(out.weight.data(), pair_weight_.data(), out.weight.size(), stream);
    copy_to_host(last_bin, bin_on_device, keeps_bin ? 1 : 0, stream);
    check(cudaStreamSynchronize(stream), "cudaStreamSynchronize");
}

void Cut::select(const SceneTables& scene, const Eyes& eyes, const SelectRule& rule,
                 SelectOutput& out, cudaStream_t stream, const PartlyResident* resident,
                 uint32_t* last_bin) {
    if (rule.fade.is_on())
        select_pairs<true>(scene, eyes, rule, out, stream, resident, last_bin);
    else
        select_pairs<false>(scene, eyes, rule, out, stream, resident, last_bin);
}

size_t Cut::bytes() const {
    return sides_.bytes() + views_.bytes() + tops_.bytes() + parts_.bytes() + states_.bytes() +
           zeros_.bytes() + budget_.bytes() + pair_instance_.bytes() + pair_cluster_.bytes() +
           pair_weight_.bytes() + pairs_.bytes();
}

}  // namespace cuda
}  // namespace v3dg
