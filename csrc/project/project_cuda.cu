// A warp takes an item, and every so many items another. It looks at the spheres of 32 gaussians at
// a time; those that may reach a pixel centre queue up, and are projected as soon as there are 32
// of them. So no lane waits for a gaussian that is not drawn, and records come out in order without
// asking another warp. Where nearly all of 32 may reach one, the next ones are projected without a
// test, which would take longer than what it spares.
//
// Of a shared item it looks at one gaussian at a time, in front of up to 32 placements: many far
// instances of a cluster of few gaussians are then a few items with full warps, and read those
// gaussians once. A kernel of its own does that, which keeps its registers out of the other.

#include "project/project_cuda.h"

#include "base/launch.cuh"
#include "frame/count_tile.cuh"
#include "frame/record.cuh"
#include "project/project_math.h"
#include "project/sources.cuh"

namespace v3dg {
namespace cuda {

namespace {

constexpr unsigned kWarps = 8;
constexpr unsigned kBlocks = 4;        // on a multiprocessor
constexpr unsigned kQueue = 64;        // fewer than 32 wait when 32 come
constexpr unsigned kMostWaiting = 64;  // large records, of which fewer than 32 wait when 32 come
// Where so many of an item's first 32 gaussians reach so few px at most, they are tested by rows.
constexpr float kSmall = 3;
constexpr unsigned kManySmall = 4;
// Where so many of 32 gaussians pass the test, the next are not tested, while so many of them
// become records.
constexpr unsigned kNearlyAll = 22, kMany = 12;

// A gaussian in front of the camera.
struct Queued {
    float p[3];      // view space
    uint32_t place;  // in the item; of a shared one, 32 times that, and the sharer's bit
};

// Shared memory of a warp.
template <class Model>
struct WarpSpace {
    ItemTables<Model> tables;
    alignas(16) Queued queue[kQueue];
    float4 ellipses[kEllipseVectors *
                    32];            // of records on their way out: written by lane, read in a row
    RecordBox boxes[kMostWaiting];  // of the item's large records that wait,
    uint8_t large[kMostWaiting];    // which they are,
    unsigned num_large;             // and how many
    WaitingTiles tiles;
};

// What is known of a gaussian from the sphere around it.
struct SphereTest {
    bool may_reach;       // a pixel centre; also where something is not a number
    bool misses_centers;  // but is in the frustum
    float half;           // px that it reaches from its centre
};

// Of a gaussian at p in view space. Without branches, because some lane of the warp would take each
// of them.
template <class Source>
__device__ SphereTest test_sphere(const ItemTables<typename Source::Model>& in, const float p[3],
                                  float reach, float reach_scale) {
    const Intrinsics<float>& cam = in.image.camera;
    const auto [u, v, half] =
        cam.image_of_sphere(p, reach, reach_scale, in.item.appearance.filter_px2);
    const float middle_x = 0.5f * cam.width, middle_y = 0.5f * cam.height;
    const float from_x = fabsf(u - middle_x), from_y = fabsf(v - middle_y);
    const bool is_outside = !(cam.depth_of(p) >= cam.near_depth) | (reach < 0) |
                            (from_x - half >= middle_x) | (from_y - half >= middle_y);
    // With its centre in the image it is in the frustum for certain, unless it is made too faint.
    const bool is_faded = Source::kFades && in.item.weight < 1;
    const bool is_inside =
        (from_x < middle_x) & (from_y < middle_y) & !in.item.appearance.antialiased & !is_faded;
    const bool misses = is_inside & (misses_centers(u, half) | misses_centers(v, half));
    return {!(is_outside | misses), misses && !is_outside, half};
}

// Leaves out the first and the last row of a box where the ellipse misses all of their pixel
// centres, with a margin, so that the blend step alone decides.
__device__ void drop_missed_rows(const Ellipse<float>& e, const Projection<float>& s,
                                 float image_width, PixelBox<int>& box) {
    const float slope = quotient_of(s.c12, s.c22), u = e.u - 0.5f;
    const float margin = 2e-3f + 4e-7f * (2 * fabsf(e.u) + image_width);
    const float reach = e.log2_opacity - static_cast<float>(kLog2MinAlpha) + 1e-4f;
    const auto misses = [&](int row) {
        const float dy = static_cast<float>(row) + 0.5f - e.v;
        // In this row alpha is largest here. No pixel centre, whether in the image or not, is
        // nearer than the one that this rounds to.
        const float middle = slope * dy + u;
        const float t1 = e.l11 * fmaxf(fabsf(middle - round_of(middle)) - margin, 0.0f),
                    t2 = e.l22 * dy;
        return t1 * t1 + t2 * t2 > reach;
    };
    const bool misses_first = misses(box.y0), misses_last = misses(box.y1);
    box.y0 += misses_first;
    box.y1 -= misses_last;
}

// What an item's gaussians are like.
struct ItemTraits {
    bool are_small;   // as the first of them tell
    bool have_shade;  // beyond the colour that project() finds
};

// The record of gaussian g at p in view space, but for its pixels, which are `box`. Returns whether
// it reaches a pixel centre; where gaussians are not small those few that miss all centres in their
// box count, too. Goes through all of it for those that do not, and for lanes without one, because
// others of the warp do.
template <class Source>
__device__ bool project_one(const ItemTables<typename Source::Model>& in,
                            const ModelView<float>& view, typename Source::Place place, uint32_t g,
                            const float p[3], bool is_one, const ItemTraits& traits,
                            Record<float>& r, PixelBox<int>& box, unsigned& num_in_frustum) {
    Projection<float> s;
    for (int i = 0; i < 3; ++i) s.p[i] = p[i];
    const Ellipse<float> e = Source::project(in, view, place, g, s, r.color);
    float half_x, half_y;
    const Intrinsics<float>& cam = in.image.camera;
    // The sphere has told that it is not too faint.
    bool is_in_frustum = is_one & extent_of(1.0f, e, s, half_x, half_y);
    is_in_frustum &= meets_image(e.u, half_x, cam.width) & meets_image(e.v, half_y, cam.height);
    num_in_frustum += is_in_frustum;
    box = pixel_box(e, half_x, half_y, cam);
    if (traits.are_small) drop_missed_rows(e, s, cam.width, box);
    set_ellipse(e, r);
    const bool reaches_pixel = is_in_frustum & box.holds_pixels();
    if (reaches_pixel && traits.have_shade) Source::shade(in.model, view, place, g, r.color);
    return reaches_pixel;
}

// A table is copied by a warp, a word a lane.
template <class T>
__device__ uint32_t load_word(const T& from) {
    static_assert(sizeof(T) <= 32 * sizeof(uint32_t), "a warp copies a table");
    const unsigned lane = threadIdx.x % 32;
    return lane < sizeof(T) / sizeof(uint32_t)
               ? __ldg(reinterpret_cast<const uint32_t*>(&from) + lane)
               : 0;
}
template <class T>
__device__ void store_word(T& to, uint32_t word) {
    const unsigned lane = threadIdx.x % 32;
    if (lane < sizeof(T) / sizeof(uint32_t)) reinterpret_cast<uint32_t*>(&to)[lane] = word;
}

// Of a large record the rows of tiles that one of `count` parts of a batch has; no record if it has
// none.
__device__ LargeRecord part_of(LargeRecord large, int part, int count) {
    const int top = large.box.y0 / kFrameTileHeight,
              rows = static_cast<int>(tile_rows_of(large.box));
    const int first = rows * part / count, end = rows * (part + 1) / count;
    if (first == end) large.record = kNoRecord;
    if (first > 0) large.box.y0 = static_cast<uint16_t>((top + first) * kFrameTileHeight);
    if (end < rows) large.box.y1 = static_cast<uint16_t>((top + end) * kFrameTileHeight - 1);
    return large;
}

// Writes the item's large records that wait: in whole batches, of which the last is filled up at
// the end of the item and waits for more before. What lies over very many tiles is written in
// parts, a batch each.
template <class Model>
__device__ void write_large(WarpSpace<Model>& space, FrameCounters& counters,
                            const ProjectOutput& out, bool is_end) {
    const unsigned num_large = space.num_large, lane = threadIdx.x % 32;
    const unsigned num_batches =
        is_end ? blocks_for(num_large, kLargeAtOnce) : num_large / kLargeAtOnce;
    if (num_batches == 0) return;
    const unsigned count = num_batches * kLargeAtOnce;
    for (unsigned first = 0; first < count; first += 32) {
        // A half of the warp has a batch.
        static_assert(kLargeAtOnce == 16, "half a warp");
        const unsigned k = first + lane;
        LargeRecord large{kNoRecord, space.tables.placement.image, {}};
        int tiles = 0;
        if (k < min(num_large, count)) {
            large.record = space.tables.item.record + space.large[k];
            large.box = space.boxes[k];
            tiles = static_cast<int>(num_tiles_of(large.box));
        }
#pragma unroll
        for (unsigned step = 1; step < kLargeAtOnce; step *= 2)
            tiles += __shfl_xor_sync(kAllLanes, tiles, step);
        const unsigned parts = k < count ? (tiles + kMostLargeTiles - 1) / kMostLargeTiles : 0;
        const unsigned of_first = __shfl_sync(kAllLanes, parts, 0),
                       before = lane < 16 ? 0 : of_first;
        unsigned long long place = 0;
        if (lane == 31)
            place = atomicAdd(&counters.large,
                              static_cast<unsigned long long>(kLargeAtOnce * (before + parts)));
        place = __shfl_sync(kAllLanes, place, 31) + kLargeAtOnce * before + lane % kLargeAtOnce;
        for (unsigned part = 0; part < parts; ++part, place += kLargeAtOnce)
            if (place < out.large_capacity)
                out.large[place] =
                    parts == 1 || large.record == kNoRecord ? large : part_of(large, part, parts);
    }
    const unsigned left = num_large - min(count, num_large);
    RecordBox box{};
    uint8_t which = 0;
    if (lane < left) {
        box = space.boxes[count + lane];
        which = space.large[count + lane];
    }
    __syncwarp();
    if (lane < left) {
        space.boxes[lane] = box;
        space.large[lane] = which;
    }
    if (lane == 0) space.num_large = left;
    __syncwarp();
}

// Writes the records of the lanes' gaussians, in their order, and counts them into tiles. Returns
// how many there are. `sharers` are the placements of a shared item.
template <class Source, bool kIsShared>
__device__ unsigned write_records(WarpSpace<typename Source::Model>& space,
                                  const Placement* sharers, const typename Source::Place& start,
                                  const ItemTraits& traits, bool has_one, const Queued& mine,
                                  uint32_t first, FrameCounters& counters, const ProjectOutput& out,
                                  unsigned& num_in_frustum) {
    const auto& in = space.tables;
    const unsigned lane = threadIdx.x % 32;
    // A lane without one takes what is there.
    const uint32_t place = has_one ? mine.place : kIsShared ? __ffs(in.item.sharers) - 1 : 0;
    const uint32_t g = in.item.first + (kIsShared ? place / 32 : place);
    const ModelView<float>& view = kIsShared ? sharers[place % 32].view : in.placement.view;
    Record<float> r;
    PixelBox<int> box;
    const bool reaches_pixel =
        project_one<Source>(in, view, start, g, mine.p, has_one, traits, r, box, num_in_frustum);
    const unsigned kept = __ballot_sync(kAllLanes, reaches_pixel);
    if (kept == 0) return 0;
    const unsigned rank = __popc(kept & ((1u << lane) - 1));
    const EntryBox blocks = entry_box(box);
    TileBox tiles = tile_box(blocks);
    const uint32_t tile = tiles.top * static_cast<uint32_t>(in.image.tile_columns) + tiles.left;
    const bool is_large = reaches_pixel && (tiles.count > kFewTiles || tile > kMostFewTile);
    const auto pixels = [&] {
        return RecordBox{static_cast<uint16_t>(box.x0), static_cast<uint16_t>(box.x1),
                         static_cast<uint16_t>(box.y0), static_cast<uint16_t>(box.y1)};
    };
    if (reaches_pixel) {
        space.ellipses[kEllipseVectors * rank] = {r.u, r.v, r.l11, r.l12};
        space.ellipses[kEllipseVectors * rank + 1] = {r.l22, r.log2_opacity, r.color[0],
                                                      r.color[1]};
        reinterpret_cast<float2*>(out.records.rest)[first + rank] = {r.color[2], r.depth};
        const uint32_t depth =
            entry_depth(r.depth, in.image.camera.near_depth, out.records.depth_mask);
        out.few[first + rank] = is_large ? kManyTiles : few_tiles(depth, tile, blocks);
        if (out.source != nullptr) {  // a tape is kept
            out.source[first + rank] = g;
            out.records.box[first + rank] = pixels();
        }
    }
    if (!reaches_pixel || is_large) tiles.count = 0;
    const unsigned large = __ballot_sync(kAllLanes, is_large);
    if (large != 0) {
        const unsigned before = space.num_large,
                       place = before + __popc(large & ((1u << lane) - 1));
        if (is_large) {
            space.large[place] = static_cast<uint8_t>(first + rank - in.item.record);
            space.boxes[place] = pixels();
        }
        __syncwarp();
        if (lane == 0) space.num_large = before + __popc(large);
    }
    __syncwarp();
    if (large != 0 && space.num_large >= 32) write_large(space, counters, out, false);
    float4* ellipses =
        reinterpret_cast<float4*>(out.records.ellipse) + kEllipseVectors * size_t(first);
    const unsigned num_records = __popc(kept);
#pragma unroll
    for (unsigned w = lane; w < kEllipseVectors * 32; w += 32)
        if (w < kEllipseVectors * num_records) ellipses[w] = space.ellipses[w];
    count_tiles(
        out.tiles.count, tiles.count,
        [&](unsigned k) {
            return in.image.first_tile + tile + tiles.rows_to(k) * in.image.tile_columns +
                   tiles.columns_to(k);
        },
        space.tiles);
    return num_records;
}

// Whose tables a warp has.
struct Loaded {
    uint32_t image = ~0u, model = ~0u;
};

// The tables of an item, from their words.
template <class Model>
__device__ void store_tables(ItemTables<Model>& tables, uint32_t item_word, uint32_t placement_word,
                             const ProjectInput& in, const Model* models, Loaded& loaded) {
    store_word(tables.item, item_word);
    store_word(tables.placement, placement_word);
    __syncwarp();
    if (tables.placement.image != loaded.image) {
        loaded.image = tables.placement.image;
        store_word(tables.image, load_word(in.images[loaded.image]));
        __syncwarp();
        if (threadIdx.x % 32 == 0) tables.limits = tables.image.camera.limits();
    }
    if (tables.placement.model != loaded.model) {
        loaded.model = tables.placement.model;
        store_word(tables.model, load_word(models[loaded.model]));
    }
    __syncwarp();
}

// The item whose tables are there. Returns how many records it has.
template <class Source, bool kIsShared>
__device__ unsigned project_item(WarpSpace<typename Source::Model>& space, const Placement* sharers,
                                 FrameCounters& counters, const ProjectOutput& out,
                                 unsigned& num_in_frustum) {
    constexpr unsigned kRound = kIsShared ? 1 : 32;  // gaussians
    const auto& tables = space.tables;
    const unsigned lane = threadIdx.x % 32, count = tables.item.count;
    if (lane == 0) space.num_large = 0;
    const bool sees = !kIsShared || (tables.item.sharers >> lane & 1) != 0;
    ModelView<float> of_sharer;
    if (kIsShared && sees) of_sharer = sharers[lane].view;
    const ModelView<float>& view = kIsShared ? of_sharer : tables.placement.view;
    const auto reach_scale_of = [&] {
        const float* linear = view.linear;
        return tables.image.camera.sphere_scale(
            tables.limits, linear[6] * linear[6] + linear[7] * linear[7] + linear[8] * linear[8]);
    };
    const float reach_scale = sees ? reach_scale_of() : 0;
    unsigned head = 0, waiting = 0;
    uint32_t record = tables.item.record;  // the next one
    ItemTraits traits{false, Source::has_shade(tables.model)};
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
        Queued mine{{}, kIsShared ? 32 * place + lane : place};
        if (place < count && sees) {
            const float4 sphere =
                Source::sphere(tables.model, here, tables.item.first + place, fetched);
            const float mean[3] = {sphere.x, sphere.y, sphere.z};
            to_view(view, mean, mine.p);
            if (are_tested) {
                const SphereTest told = test_sphere<Source>(tables, mine.p, sphere.w, reach_scale);
                may_reach = told.may_reach;
                is_small = may_reach && told.half < kSmall;
                num_in_frustum += told.misses_centers;
            } else {
                may_reach = mine.p[2] >= tables.image.camera.near_depth && !(sphere.w < 0);
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
            // After the last there may be two rounds left.
            const unsigned taken = min(waiting, 32u);
            may_reach = lane < taken;
            if (may_reach) mine = space.queue[(head + lane) % kQueue];
            head += taken;
            waiting -= taken;
            are_tested = !are_nearly_all || waiting > 0;
        }
        const unsigned num_records = write_records<Source, kIsShared>(
            space, sharers, start, traits, may_reach, mine, record, counters, out, num_in_frustum);
        record += num_records;
        are_tested = are_tested || num_records < kMany;
        __syncwarp();  // before the queue and the records are written again
    }
    write_large(space, counters, out, true);
    return record - tables.item.record;
}

template <class Model>
__device__ void report_item(const ItemTables<Model>& tables, unsigned item, unsigned num_records,
                            const ProjectOutput& out) {
    if (threadIdx.x % 32 != 0) return;
    out.item_records[item] = num_records;
    out.item_tiles[item] = {num_records, tables.item.record, tables.image.first_tile,
                            static_cast<uint32_t>(tables.image.tile_columns)};
}

__device__ void report_counts(FrameCounters& counters, unsigned num_in_frustum,
                              unsigned num_records) {
    num_in_frustum = warp_sum(num_in_frustum);
    if (threadIdx.x % 32 != 0 || num_in_frustum == 0)
        return;  // there is no record that is not in it
    atomicAdd(&counters.in_frustum, static_cast<unsigned long long>(num_in_frustum));
    atomicAdd(&counters.records, static_cast<unsigned long long>(num_records));
}

template <class Source>
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
    __syncwarp();  // A warp without an item reads it next.
    // Items differ much in what is seen of them, so a warp asks for another one as it begins with
    // one.
    for (unsigned i = blockIdx.x * kWarps + threadIdx.x / 32; i < num_items;) {
        const uint32_t item_word = load_word(in.items.items[i]);
        const unsigned next = take_next(taken, gridDim.x * kWarps);
        const uint32_t placement_word =
            load_word(in.placements[__shfl_sync(kAllLanes, item_word, 0)]);
        __syncwarp();
        store_tables(space.tables, item_word, placement_word, in, models, loaded);
        if (space.tables.item.sharers == 0 && Source::has(space.tables.model)) {
            const unsigned written = project_item<Source, false>(space, nullptr, *in.items.counters,
                                                                 out, num_in_frustum);
            num_records += written;
            report_item(space.tables, i, written, out);
        }
        i = __shfl_sync(kAllLanes, next, 0);
    }
    count_waiting(out.tiles.count, space.tiles);
    report_counts(*in.items.counters, num_in_frustum, num_records);
}

// Most frames have few shared items, so a warp looks for them among 32 items at a time.
template <class Source>
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
    __syncwarp();  // A warp without an item reads it next.
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
            const unsigned written =
                project_item<Source, true>(space, sharers, *in.items.counters, out, num_in_frustum);
            num_records += written;
            report_item(space.tables, i, written, out);
        }
    }
    count_waiting(out.tiles.count, space.tiles);
    report_counts(*in.items.counters, num_in_frustum, num_records);
}

// Packs a gaussian into a row of four planes of `num_rows`.
__device__ void pack_row(const Gaussian3d<float>& gaussian, const float* sh, float4* planes,
                         size_t num_rows, size_t row) {
    const PackedGaussian p = pack_gaussian(gaussian);
    planes[row] = {p.mean[0], p.mean[1], p.mean[2], p.reach};
    planes[num_rows + row] = {p.f[0], p.f[1], p.f[2], p.f[3]};
    planes[2 * num_rows + row] = {p.f[4], p.f[5], p.f[6], p.f[7]};
    float color[3];
    color_of_sh(0, gaussian.mean, sh, color);
    planes[3 * num_rows + row] = {p.log2_opacity, color[0], color[1], color[2]};
}

__device__ Gaussian3d<float> gaussian_of(const GaussianRows<const float>& rows, size_t g) {
    Gaussian3d<float> gaussian;
    for (int k = 0; k < 3; ++k) gaussian.mean[k] = rows.means[3 * g + k];
    for (int k = 0; k < 4; ++k) gaussian.quat[k] = rows.quats[4 * g + k];
    for (int k = 0; k < 3; ++k) gaussian.scale[k] = rows.scales[3 * g + k];
    gaussian.opacity = rows.opacities[g];
    return gaussian;
}

// A thread a gaussian.
__global__ void pack_kernel(GaussianRows<const float> rows, float4* planes) {
    const size_t g = blockIdx.x * size_t(blockDim.x) + threadIdx.x;
    if (g < rows.size)
        pack_row(gaussian_of(rows, g), rows.sh + g * rows.num_sh(), planes, rows.size, g);
}

// Of the row of a page of codes; `sh` has room for all coefficients.
__device__ Gaussian3d<float> decoded(const PageCodes<const uint32_t>& codes, size_t row,
                                     float* sh) {
    size_t cluster = codes.num_clusters() - 1;  // the last that begins at or before the row
    while (static_cast<size_t>(codes.offset[cluster]) > row) --cluster;
    const uint32_t* words = codes.ranges(cluster);
    const auto& code = *reinterpret_cast<const ClusterCode*>(words);
    const auto* steps = reinterpret_cast<const uint16_t*>(words + sizeof(ClusterCode) / 4);
    const ClusterRanges ranges = ranges_of(code, steps, codes.sh_degree);
    Gaussian3d<float> gaussian;
    decode(codes.record(row), ranges, gaussian, sh);
    decode_sh(codes.sh(row), ranges.sh_step, codes.sh_degree, sh + 3);
    return gaussian;
}

// A block a page. The coefficients of degree 0 are in the planes.
__global__ void pack_pages_kernel(const PageRows* pages, float4* planes, size_t num_rows, float* sh,
                                  int sh_stride) {
    const PageRows page = pages[blockIdx.x];
    const unsigned num_sh = page.rows.num_sh();
    for (size_t g = threadIdx.x; g < page.rows.size; g += blockDim.x) {
        const size_t row = page.first_row + g;
        if (page.codes.words == nullptr) {
            pack_row(gaussian_of(page.rows, g), page.rows.sh + g * num_sh, planes, num_rows, row);
            continue;
        }
        float own_sh[3 * kMaxShBases];
        const Gaussian3d<float> gaussian = decoded(page.codes, page.codes.first_row() + g, own_sh);
        pack_row(gaussian, own_sh, planes, num_rows, row);
        for (unsigned k = 0; k < num_sh && page.rows.sh_degree > 0; ++k)
            sh[row * sh_stride + k] = own_sh[k];
    }
    if (page.rows.sh_degree == 0 || page.codes.words != nullptr) return;
    for (unsigned i = threadIdx.x; i < num_sh * page.rows.size; i += blockDim.x)
        sh[(page.first_row + i / num_sh) * sh_stride + i % num_sh] = page.rows.sh[i];
}

}  // namespace

PackedPlanes pack(const GaussianRows<const float>& rows, float* planes, cudaStream_t stream) {
    const size_t count = rows.size;
    constexpr unsigned kThreads = 256;
    launch("pack_kernel", pack_kernel, blocks_for(count, kThreads), kThreads, 0, stream, rows,
           reinterpret_cast<float4*>(planes));
    return {{planes, planes + 4 * count, planes + 8 * count, planes + 12 * count},
            rows.sh,
            rows.sh_degree,
            rows.num_sh(),
            {}};
}

void pack_pages(const PageRows* pages, size_t num_pages, float* planes, size_t num_rows, float* sh,
                int sh_stride, cudaStream_t stream) {
    constexpr unsigned kThreads = 128;
    launch("pack_pages_kernel", pack_pages_kernel, static_cast<unsigned>(num_pages), kThreads, 0,
           stream, pages, reinterpret_cast<float4*>(planes), num_rows, sh, sh_stride);
}

// Shared items have no weights below 1.
template <class Source, class SharedSource>
static void project_from(const typename Source::Model* models, const ProjectInput& in,
                         const ProjectOutput& out, int taken, cudaStream_t stream) {
    const unsigned blocks = kBlocks * num_multiprocessors();
    launch_early("project_kernel", project_kernel<Source>, blocks, 32 * kWarps, 0, stream, in,
                 models, out, out.taken + taken);
    if (in.has_shared_items)
        launch_early("project_shared_kernel", project_shared_kernel<SharedSource>, blocks,
                     32 * kWarps, 0, stream, in, models, out);
}

template <class Source>
static void project_scene(const typename Source::Model* models, const ProjectInput& in,
                          const ProjectOutput& out, int taken, cudaStream_t stream) {
    if (in.has_faded_items)
        project_from<Faded<Source>, Source>(models, in, out, taken, stream);
    else
        project_from<Source, Source>(models, in, out, taken, stream);
}

void project(const ProjectInput& in, const ProjectOutput& out, cudaStream_t stream) {
    if (in.packed != nullptr) project_scene<PackedSource>(in.packed, in, out, 0, stream);
    if (in.coded != nullptr) project_scene<CodeSource>(in.coded, in, out, 1, stream);
    if (in.packed == nullptr && in.coded == nullptr)
        project_from<RowSource, RowSource>(in.models, in, out, 0, stream);
}

}  // namespace cuda
}  // namespace v3dg
