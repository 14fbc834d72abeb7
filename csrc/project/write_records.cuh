#pragma once

// Projects one gaussian per lane of a warp, and writes a record for each gaussian that
// reaches a pixel centre.

#include "project/large_records.cuh"
#include "project/project_math.h"
#include "project/sphere_test.cuh"
#include "project/warp_space.cuh"

namespace v3dg {
namespace cuda {

// Properties of an item's gaussians.
struct ItemTraits {
    bool are_small;   // whether the first 32 gaussians are small on the image
    bool have_shade;  // whether shade() sets the final colour
};

// Computes the record of gaussian g, whose mean is p in view space, and its pixel
// `box`. Returns whether the gaussian reaches a pixel centre. Unless traits.are_small,
// it also returns true for a few gaussians that reach none. The function never returns
// early, even if the lane has no gaussian (!is_one), because all lanes of a warp must
// stay together.
template <class Source, class C>
__device__ bool project_one(const ItemTables<typename Source::Model>& in,
                            const ModelView<float>& view, typename Source::Place place, uint32_t g,
                            const float p[3], bool is_one, const ItemTraits& traits,
                            const InstanceFactors* factors, Record<float>& r, PixelBox<int>& box,
                            unsigned& num_in_frustum) {
    Projection<float, C> s;
    for (int i = 0; i < 3; ++i) s.p[i] = p[i];
    Ellipse<float> e = Source::project(in, view, place, g, s, r.color);
    if constexpr (Source::kTints) fade(factors->opacity, e);
    float half_x, half_y;
    const C& cam = camera_as<C>(in);
    // The sphere test has removed gaussians that are too faint, so pass an opacity of
    // 1.
    bool is_in_frustum = is_one & extent_of(1.0f, e, s, half_x, half_y);
    is_in_frustum &= meets_image(e.u, half_x, cam.width) & meets_image(e.v, half_y, cam.height);
    num_in_frustum += is_in_frustum;
    box = pixel_box(e, half_x, half_y, cam);
    if (traits.are_small) drop_missed_rows(e, s, cam.width, box);
    set_ellipse(e, r);
    const bool reaches_pixel = is_in_frustum & box.holds_pixels();
    if (reaches_pixel && traits.have_shade) Source::shade(in.model, view, place, g, r.color);
    if constexpr (Source::kTints)
        if (!Source::has_palette(in.model)) tint(factors->color, r.color);
    return reaches_pixel;
}

// Writes the records of the lanes' gaussians, in lane order, beginning at index
// `first`. Adds them to the counts of tiles, and returns the number of records.
// `sharers` are the placements of a shared item. `factors` points to the factors of the
// sharers or, if the item is not shared, of its placement. It is null if the source
// does not use factors.
template <class Source, bool kIsShared, class C>
__device__ unsigned write_records(WarpSpace<typename Source::Model>& space,
                                  const Placement* sharers, const InstanceFactors* factors,
                                  const typename Source::Place& start, const ItemTraits& traits,
                                  bool has_one, const Queued& mine, uint32_t first,
                                  FrameCounters& counters, const ProjectOutput& out,
                                  unsigned& num_in_frustum) {
    const auto& in = space.tables;
    const unsigned lane = threadIdx.x % 32;
    // A lane without a gaussian computes a valid one, and discards the result.
    const uint32_t place = has_one ? mine.place : kIsShared ? __ffs(in.item.sharers) - 1 : 0;
    const uint32_t g = in.item.first + (kIsShared ? place / 32 : place);
    const ModelView<float>& view = kIsShared ? sharers[place % 32].view : in.placement.view;
    Record<float> r;
    PixelBox<int> box;
    const bool reaches_pixel = project_one<Source, C>(
        in, view, start, g, mine.p, has_one, traits,
        Source::kTints && kIsShared ? factors + place % 32 : factors, r, box, num_in_frustum);
    const unsigned kept = __ballot_sync(kAllLanes, reaches_pixel);
    if (kept == 0) return 0;
    const unsigned rank = __popc(kept & ((1u << lane) - 1));
    const EntryBox blocks = entry_box(box);
    TileBox tiles = tile_box(blocks);
    const uint32_t tile = tiles.top * static_cast<uint32_t>(in.image.tile_columns) + tiles.left;
    const bool is_large = reaches_pixel && (tiles.count > kFewTiles || tile > kMostFewTile);
    const auto pixels = [&] {
        return RecordBox{.x0 = static_cast<uint16_t>(box.x0),
                         .x1 = static_cast<uint16_t>(box.x1),
                         .y0 = static_cast<uint16_t>(box.y0),
                         .y1 = static_cast<uint16_t>(box.y1)};
    };
    if (reaches_pixel) {
        space.ellipses[kEllipseVectors * rank] = {r.u, r.v, r.l11, r.l12};
        space.ellipses[kEllipseVectors * rank + 1] = {r.l22, r.log2_opacity, r.color[0],
                                                      r.color[1]};
        reinterpret_cast<float2*>(out.records.rest)[first + rank] = {r.color[2], r.depth};
        const uint32_t depth =
            entry_depth(r.depth, in.image.camera.near_depth, out.records.depth_mask);
        out.few[first + rank] = is_large ? kManyTiles : few_tiles(depth, tile, blocks);
        if (out.source != nullptr) {
            out.source[first + rank] = Source::kPlaces ? place : g;
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

}  // namespace cuda
}  // namespace v3dg
