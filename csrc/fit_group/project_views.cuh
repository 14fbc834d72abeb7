#pragma once

// Projects the gaussians of a group into the views of a batch, with one thread per
// gaussian and view. Also computes the gradients of parameters from the gradients of
// records.

#include <type_traits>

#include "fit_group/cell_lists.cuh"
#include "fit_group/parameters.cuh"

namespace v3dg {
namespace cuda {

// Calls `body` with the degree as a compile-time constant, so that loops are unrolled.
template <class Body>
__device__ void with_degree(int degree, const Body& body) {
    switch (degree) {
        case 0: return body(std::integral_constant<int, 0>{});
        case 1: return body(std::integral_constant<int, 1>{});
        case 2: return body(std::integral_constant<int, 2>{});
        default: return body(std::integral_constant<int, 3>{});
    }
}

template <class Fit>
__device__ bool project_one(const Fit& fit, uint32_t i, const ModelView<float>& view,
                            const Pinhole<float>& camera, Record<float>& r) {
    const Gaussian3d<float> g = gaussian_of(fit, i);
    Projection<float, Pinhole<float>> p;
    to_view(view, g.mean, p.p);
    const Ellipse<float> e =
        project_gaussian(g, view, camera, fit.in.config.filter_px2, fit.in.config.antialiased, p);
    float half_x, half_y;
    if (!(e.depth >= camera.near_depth) || !extent_of(g.opacity, e, p, half_x, half_y))
        return false;
    if (!meets_image(e.u, half_x, camera.width) || !meets_image(e.v, half_y, camera.height))
        return false;
    const PixelBox<int> box = pixel_box(e, half_x, half_y, camera);
    if (!box.holds_pixels()) return false;
    set_ellipse(e, box, r);
    const float* sh = fit.at(fit.layout.value) + 11 * fit.n + fit.num_sh * i;
    float direction[3];
    from_eye(view, g.mean, direction);
    with_degree(fit.in.rows.sh_degree, [&](auto degree) {
        color_of_sh<float>(decltype(degree)::value, direction, sh, r.color);
    });
    return true;
}

template <class Fit>
__device__ void project_views(const Fit& fit, const FitCameras& cameras, int num_views) {
    for (uint32_t j = fit.first(); j < num_views * fit.n_padded; j += fit.stride()) {
        const uint32_t b = j / fit.n_padded, i = j - b * fit.n_padded;
        uint32_t key = kHiddenKey;
        CellMask reached = 0;
        if (i < fit.n) {
            Record<float> r;
            if (project_one(fit, i, cameras.view[b], cameras.camera[b], r)) {
                fit.records()[j] = r;
                key = __float_as_uint(r.depth);
                if (Fit::kSmall) reached = cells_of(r, 0, 0);
            }
        }
        fit.keys()[j] = key;
        if (Fit::kSmall) fit.mask(0)[j] = reached;
    }
    if (fit.leads()) {
        Record<float> r{};
        r.log2_opacity = -100;
        fit.ranked()[fit.nothing()] = r;
    }
}

// Computes the gradients of the parameters for each view, from the sums of records.
template <class Fit>
__device__ void project_views_backward(const Fit& fit, const FitCameras& cameras, int num_views,
                                       int turn) {
    const float* sums = fit.at(fit.layout.sums);
    const float* value = fit.at(fit.layout.value);
    for (uint32_t j = fit.first(); j < num_views * fit.n_padded; j += fit.stride()) {
        const uint32_t b = j / fit.n_padded, place = Fit::kSmall ? j : fit.order()[j],
                       i = place - b * fit.n_padded;
        if (i >= fit.n) continue;
        float* out = fit.gradient(turn, fit.view_rank + b);
        float* d_sh = out + 11 * fit.n + fit.num_sh * i;
        if (Fit::kSmall ? fit.mask(0)[place] == 0 : fit.keys()[place] == kHiddenKey) {
            for (int k = 0; k < 11; ++k) out[k * fit.n + i] = 0;
            for (int k = 0; k < fit.num_sh; ++k) d_sh[k] = 0;
            continue;
        }
        const float* d = sums + kSumStride * j;
        const ModelView<float>& view = cameras.view[b];
        const Pinhole<float>& camera = cameras.camera[b];
        const float filter_px2 = fit.in.config.filter_px2;
        const bool antialiased = fit.in.config.antialiased;
        const Gaussian3d<float> g = gaussian_of(fit, i);
        Projection<float, Pinhole<float>> p;
        to_view(view, g.mean, p.p);
        const Ellipse<float> e = project_gaussian(g, view, camera, filter_px2, antialiased, p);
        const Ellipse<float> d_ellipse = falloff_vjp(e.l11, e.l12, e.l22,
                                                     FalloffSums<float>{.exponent = d[0],
                                                                        .t1 = d[1],
                                                                        .t2 = d[2],
                                                                        .t1_dx = d[3],
                                                                        .t1_dy = d[4],
                                                                        .t2_dy = d[5]});
        Gaussian3d<float> d_g =
            project_gaussian_vjp(g, view, camera, filter_px2, antialiased, p, e, d_ellipse);
        const float* sh = value + 11 * fit.n + fit.num_sh * i;
        float direction[3];
        from_eye(view, g.mean, direction);
        with_degree(fit.in.rows.sh_degree, [&](auto degree) {
            float color[3];
            constexpr int kDegree = decltype(degree)::value;
            color_of_sh<float>(kDegree, direction, sh, color);
            color_of_sh_vjp<float>(kDegree, direction, sh, color, d + 6, d_g.mean, d_sh);
        });
        for (int k = 0; k < 3; ++k) out[k * fit.n + i] = d_g.mean[k];
        for (int k = 0; k < 4; ++k) out[(3 + k) * fit.n + i] = d_g.quat[k];
        for (int k = 0; k < 3; ++k) out[(7 + k) * fit.n + i] = d_g.scale[k] * g.scale[k];
        out[10 * fit.n + i] = d_g.opacity * g.opacity * (1 - g.opacity);
    }
}

}  // namespace cuda
}  // namespace v3dg
