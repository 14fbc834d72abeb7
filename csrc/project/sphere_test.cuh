#pragma once

// Tests that are run before projection. They find gaussians, or rows of pixels, for
// which no pixel centre is drawn. They only save work: the blend step would discard
// everything that they discard.

#include "project/project_math.h"
#include "project/sources.cuh"

namespace v3dg {
namespace cuda {

// The result of testing the bounding sphere of a gaussian.
struct SphereTest {
    bool may_reach;       // may reach a pixel centre; also true for NaN
    bool misses_centers;  // is in the frustum, but reaches no pixel centre
    float half;           // upper bound on the half extent, px
};

// Tests a gaussian at p in view space. `is_faint` is true if its instance has an
// opacity below 1. The function has no branches, because the lanes of a warp would
// diverge.
template <class Source, class C>
__device__ SphereTest test_sphere(const ItemTables<typename Source::Model>& in, const float p[3],
                                  float reach, float reach_scale, bool is_faint) {
    const C& cam = camera_as<C>(in);
    const auto [u, v, half] =
        cam.image_of_sphere(p, reach, reach_scale, in.item.appearance.filter_px2);
    const float middle_x = 0.5f * cam.width, middle_y = 0.5f * cam.height;
    const float from_x = fabsf(u - middle_x), from_y = fabsf(v - middle_y);
    const bool is_outside = !(cam.depth_of(p) >= cam.near_depth) | (reach < 0) |
                            (from_x - half >= middle_x) | (from_y - half >= middle_y);
    // A gaussian whose centre is in the image is in the frustum, unless antialiasing, a
    // fade or its instance makes it too faint to be drawn.
    const bool is_faded = (Source::kFades && in.item.weight < 1) || is_faint;
    const bool is_inside =
        (from_x < middle_x) & (from_y < middle_y) & !in.item.appearance.antialiased & !is_faded;
    const bool misses = is_inside & (misses_centers(u, half) | misses_centers(v, half));
    return {
        .may_reach = !(is_outside | misses), .misses_centers = misses && !is_outside, .half = half};
}

// Removes the first and the last row from a pixel box if the ellipse reaches no pixel
// centre in that row. A margin accounts for rounding, so that only the blend step
// decides about a pixel.
template <class C>
__device__ void drop_missed_rows(const Ellipse<float>& e, const Projection<float, C>& s,
                                 float image_width, PixelBox<int>& box) {
    const float slope = quotient_of(s.c12, s.c22), u = e.u - 0.5f;
    const float margin = 2e-3f + 4e-7f * (2 * fabsf(e.u) + image_width);
    const float reach = e.log2_opacity - static_cast<float>(kLog2MinAlpha) + 1e-4f;
    const auto misses = [&](int row) {
        const float dy = static_cast<float>(row) + 0.5f - e.v;
        // In this row of pixels, alpha is largest at x = `middle`. Rounding gives the
        // nearest pixel centre, which may be outside the image.
        const float middle = slope * dy + u;
        const float t1 = e.l11 * fmaxf(fabsf(middle - round_of(middle)) - margin, 0.0f),
                    t2 = e.l22 * dy;
        return t1 * t1 + t2 * t2 > reach;
    };
    const bool misses_first = misses(box.y0), misses_last = misses(box.y1);
    box.y0 += misses_first;
    box.y1 -= misses_last;
}

}  // namespace cuda
}  // namespace v3dg
