// Selects the cut of a scene on the device, in two kernels.
//
// place_kernel has one thread per instance (place_instances.cuh). It transforms the
// camera into the coordinates of the instance, and chooses the source of the instance's
// cut: nothing, the top clusters, or the whole table. It also divides the work into
// parts for cut_kernel. A part is one of three things: up to 256 clusters of one table
// that bounds could not exclude; the top clusters of up to 32 consecutive instances; or
// the last clusters of such instances' tables, if one lane per instance suffices.
//
// A block of cut_kernel processes up to eight parts, one per warp. It tests which
// clusters are drawn (cut_parts.cuh), records which pages they need (page_needs.cuh),
// and writes the drawn clusters to positions that a prefix sum gives
// (write_clusters.cuh).
//
// With a budget, place_kernel and the kernels of budget_cuda.cu run in two rounds
// before cut_kernel.

#include "select/select_cuda.h"

#include <algorithm>

#include "base/device_guard.h"
#include "base/scan.cuh"
#include "select/cut_kernel.cuh"
#include "select/cut_parts.cuh"
#include "select/cut_scratch.cuh"
#include "select/draw_items.cuh"
#include "select/page_needs.cuh"
#include "select/place_instances.cuh"
#include "select/write_clusters.cuh"

namespace v3dg {
namespace cuda {

// Optional outputs of a cut: the choice of a budget, and the pictures and placements of
// a frame. A pointer is null if its output is not requested.
struct Cut::Target {
    EyeImages pictures;
    FrameImage* images;
    Placement* placements;
    CutChoice* choice;
};

namespace {

constexpr unsigned kReportBlocks = 64;

__global__ void sides_kernel(const BundleOnDevice* bundles, size_t num_bundles, Eyes eyes,
                             CameraSides* sides) {
    const size_t b = size_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (b < num_bundles) sides[b] = sides_of_eyes(eyes, bundles[b].table.pad_px);
}

// Launched with one thread per instance. `kAreTwo` means that there are two eyes.
template <bool kAreTwo>
__global__ void __launch_bounds__(kPlaceThreads, kAreTwo ? kPlaceBlocks / 2 : kPlaceBlocks)
    place_kernel(PlacedScene scene, Eyes eyes, BundleSides sides, SelectRule rule,
                 EyeImages pictures, FrameImage* images, Placement* placements, BudgetRound round,
                 CutScratch scratch) {
    if (round.is_over()) return;
    eyes.are_two = kAreTwo;
    rule.tolerance_px2 = round.least_tolerance(rule);
    const size_t block = take_ticket(scratch.place_ticket), i = block * kPlaceThreads + threadIdx.x;
    if (i < pictures.count) images[i] = pictures.image[i];
    const size_t num_instances = scene.instances.scale.size;
    const InstanceSlot slot{.is_taken = i < num_instances, .instance = i, .place = i, .image = 0};
    const Placed placed = place_instance(scene, slot, eyes, sides, rule, placements);
    const unsigned num_parts = write_parts(scene, placed, block, i, num_instances, scratch);
    if (block + 1 == gridDim.x && threadIdx.x == 0) *scratch.num_parts = num_parts;
}

__global__ void report_kernel(NeedList needs, SelectRule rule, const CutChoice* choice) {
    report_needs(needs, rule, choice);
}

// Launched with one thread per instance.
__global__ void place_all_kernel(PlacedScene scene, Camera camera, FrameImage image,
                                 FrameImage* images, Placement* placements) {
    const size_t i = size_t(blockIdx.x) * blockDim.x + threadIdx.x;
    if (i == 0) images[0] = image;
    if (i >= scene.instances.scale.size) return;
    const Pose pose = scene.instances.pose(i);
    placements[i] =
        placement_of(axes_of_instance(camera, pose), pose, scene.instances.bundle[i], 0);
}

// Launched with one thread per pair. Skips pairs whose instance is not drawn.
template <class Output>
__global__ void __launch_bounds__(kCutThreads)
    given_kernel(PlacedScene scene, GivenCut given, CutScratch scratch, Output output) {
    const unsigned ticket = take_ticket(scratch.cut_ticket);
    const size_t p = size_t(ticket) * kCutThreads + threadIdx.x;
    LaneClusters mine{};
    if (p < given.instance.size && scene.instances.is_drawn(given.instance[p])) {
        const int32_t i = given.instance[p];
        mine = {.bundle = &scene.bundles[scene.instances.bundle[i]],
                .place = static_cast<uint32_t>(i),
                .first = static_cast<uint32_t>(given.cluster[p]),
                .is_alone = false,
                .are_tops = false,
                .drawn = 1,
                .weights = {}};
        if (Output::kFades)
            mine.weights =
                LaneWeights::all(static_cast<int32_t>(given.weight_of(p) * kWhole + 0.5f));
    }
    write_clusters(mine, ticket, ticket + 1 == gridDim.x, scratch.unit_state, scratch.count_state,
                   output);
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
    const size_t count = scene.num_instances(), parts = scene.seen_by_all().parts;
    const unsigned num_places = kCutBlocks * num_multiprocessors();
    const size_t num_tickets = std::max<size_t>(blocks_for(parts, kCutWarps), num_places);
    Count* states = states_.reserve(4 * num_tickets, stream);
    const CutScratch scratches[2] = {scratch_in(zeros, states, num_tickets, num_places),
                                     scratch_in(zeros + zeros_of_round(count),
                                                states + 2 * num_tickets, num_tickets, num_places)};
    const SceneOnDevice on_device = scene.on_device();
    const PlacedScene placed{.bundles = resident == nullptr ? on_device.bundles : resident->bundles,
                             .instances = on_device.instances,
                             .bundle_of_place = on_device.instances.bundle.data,
                             .views = views_.reserve(count, stream),
                             .tops = tops_.reserve(count, stream),
                             .parts = parts_.reserve(parts, stream)};
    const auto blocks = static_cast<unsigned>(std::clamp<size_t>(parts, 1, 2 * num_places));
    const bool has_budget = rule.budget != kNoBudget;
    Count* change = zeros + 2 * zeros_of_round(count);  // used only with a budget
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
        const CutScratch& scratch = scratches[is_second];
        const BudgetRound round{.state = state, .is_second = is_second};
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
    const Target target{.pictures = pictures,
                        .images = images,
                        .placements = placements,
                        .choice = &items.counters->choice};
    const auto num_instances = static_cast<uint32_t>(scene.num_instances());
    const auto cut_into = [&](const auto& output) {
        cut(scene, eyes, rule, target, output, items.zeros, stream, resident);
    };
    if (rule.fade.is_on())
        cut_into(ItemOutput<true>{
            .items = items, .num_pictures = pictures.count, .num_placements = num_instances});
    else
        cut_into(ItemOutput<false>{
            .items = items, .num_pictures = pictures.count, .num_placements = num_instances});
}

void Cut::given_items(const SceneTables& scene, const Camera& camera, const GivenCut& given,
                      const FrameImage& image, FrameImage* images, Placement* placements,
                      const ItemList& items, cudaStream_t stream) {
    const DeviceGuard guard(device_);
    const StreamLock lock = scene.lock(stream);
    const SceneOnDevice on_device = scene.on_device();
    const PlacedScene placed{.bundles = on_device.bundles,
                             .instances = on_device.instances,
                             .bundle_of_place = on_device.instances.bundle.data,
                             .views = nullptr,
                             .tops = nullptr,
                             .parts = nullptr};
    const unsigned blocks = std::max(1u, blocks_for(given.instance.size, kCutThreads));
    const size_t num_zeros = zeros_of_round(0), words = num_zeros + 2 * size_t(blocks);
    Count* zeros = states_.reserve(words, stream);
    const CutScratch scratch = scratch_in(zeros, zeros + num_zeros, blocks, blocks);
    check(cudaMemsetAsync(zeros, 0, words * sizeof(Count), stream), "cudaMemsetAsync");
    launch("place_all_kernel", place_all_kernel, place_blocks(scene.num_instances()), kPlaceThreads,
           0, stream, placed, camera, image, images, placements);
    if (given.weight.size > 0)
        launch("given_kernel", given_kernel<ItemOutput<true>>, blocks, kCutThreads, 0, stream,
               placed, given, scratch,
               ItemOutput<true>{.items = items, .num_pictures = 1, .num_placements = 0});
    else
        launch("given_kernel", given_kernel<ItemOutput<false>>, blocks, kCutThreads, 0, stream,
               placed, given, scratch,
               ItemOutput<false>{.items = items, .num_pictures = 1, .num_placements = 0});
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
    // If the pairs do not fit, repeat the cut with larger buffers. Most cuts fit the
    // first time.
    for (Count capacity = std::max<Count>(1u << 16, pair_instance_.capacity());;
         capacity = counts.pairs) {
        const PairOutput<kFades> output{
            .instance = pair_instance_.reserve(capacity, stream),
            .cluster = pair_cluster_.reserve(capacity, stream),
            .weight = kFades ? pair_weight_.reserve(capacity, stream) : nullptr,
            .capacity = capacity,
            .pairs = &on_device->pairs,
            .gaussians = &on_device->gaussians};
        check(cudaMemsetAsync(on_device, 0, sizeof *on_device, stream), "cudaMemsetAsync");
        check(cudaMemsetAsync(zeros, 0, num_words * sizeof(Count), stream), "cudaMemsetAsync");
        if (keeps_bin)
            check(cudaMemcpyAsync(bin_on_device, last_bin, sizeof *last_bin, cudaMemcpyHostToDevice,
                                  stream),
                  "cudaMemcpyAsync of the last bin");
        const Target target{
            .pictures = {}, .images = nullptr, .placements = nullptr, .choice = &on_device->choice};
        cut(scene, eyes, rule, target, output, zeros, stream, resident);
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
    return sides_.bytes() + views_.bytes() + bundle_of_place_.bytes() + tops_.bytes() +
           parts_.bytes() + states_.bytes() + zeros_.bytes() + budget_.bytes() +
           pair_instance_.bytes() + pair_cluster_.bytes() + pair_weight_.bytes() + pairs_.bytes();
}

}  // namespace cuda
}  // namespace v3dg
