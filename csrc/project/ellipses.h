#pragma once

// Computes the 2D ellipses of all gaussians, even of those that are not drawn. Training
// uses them to decide where to add and remove gaussians.

#include <cstdint>

#include "base/stream.h"
#include "project/project_math.h"

namespace v3dg {

// One row per gaussian. All values of an invisible gaussian are zero. A gaussian is
// invisible if its depth is not between the near and far limits, its alpha is below
// 1/255 everywhere, it is outside the image, or its radius is at most `min_radius_px`.
template <class T>
struct Ellipses {
    T* centers;    // (N, 2) px
    T* depths;     // (N,)
    T* conics;     // (N, 3) inverse covariances as xx, xy, yy; 1 / px²
    T* opacities;  // (N,) as used for blending, including the antialiasing factor
    // (N, 2) half width and half height, px, rounded up, of the box in which alpha is
    // at least 1/255
    int32_t* radii;
};

template <class T>
struct EllipsesInput {
    GaussianRows<const T> rows;
    ModelView<T> view;
    Intrinsics<T> camera;
    T filter_px2;
    bool antialiased;
    T far_depth, min_radius_px;

    V3DG_HD void write(size_t i, const Ellipses<T>& out) const {
        camera.visit([&](const auto& model) { write_by(model, i, out); });
    }

  private:
    template <ProjectingModel C>
    V3DG_HD void write_by(const C& model, size_t i, const Ellipses<T>& out) const {
        const Gaussian3d<T> g = gaussian_in_row(rows, i);
        Projection<T, C> s;
        to_view(view, g.mean, s.p);
        const Ellipse<T> e = project_gaussian(g, view, model, filter_px2, antialiased, s);
        T half_x, half_y;
        const bool is_drawable = extent_of(g.opacity, e, s, half_x, half_y);
        const int32_t x = rounded_up(half_x), y = rounded_up(half_y);
        const bool is_seen = is_drawable & (e.depth >= camera.near_depth) & (e.depth <= far_depth) &
                             meets_image(e.u, T(x), camera.width) &
                             meets_image(e.v, T(y), camera.height) &
                             ((T(x) > min_radius_px) | (T(y) > min_radius_px));
        out.centers[2 * i] = is_seen ? e.u : T(0);
        out.centers[2 * i + 1] = is_seen ? e.v : T(0);
        out.depths[i] = is_seen ? e.depth : T(0);
        out.conics[3 * i] = is_seen ? s.c22 / s.det : T(0);
        out.conics[3 * i + 1] = is_seen ? -s.c12 / s.det : T(0);
        out.conics[3 * i + 2] = is_seen ? s.c11 / s.det : T(0);
        out.opacities[i] = !is_seen      ? T(0)
                           : antialiased ? g.opacity * sqrt_of(s.det0 / s.det)
                                         : g.opacity;
        out.radii[2 * i] = is_seen ? x : 0;
        out.radii[2 * i + 1] = is_seen ? y : 0;
    }

    // Rounds up to an integer, at most 2^30. The result is undefined for NaN.
    static V3DG_HD int32_t rounded_up(T x) {
        const auto whole = static_cast<int32_t>(min_of(max_of(x, T(0)), T(1 << 30)));
        return whole + (T(whole) < x ? 1 : 0);
    }
};

namespace cpu {
template <class T>
void ellipses(const EllipsesInput<T>& in, const Ellipses<T>& out);
}  // namespace cpu
namespace cuda {
void ellipses(const EllipsesInput<float>& in, const Ellipses<float>& out, Stream stream);
}

}  // namespace v3dg
