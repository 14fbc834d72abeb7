#pragma once

// Pictures of gaussians without levels from several cameras ("views"), and their
// gradients.

#include "bindings/batch.h"
#include "bindings/tape.h"

namespace v3dg {

// The gradients that are requested, in addition to those of all inputs.
struct ViewsWanted {
    Centers centers;
    bool poses;
    // Whether each view has its own gradients of opacities, or of SH coefficients: (V,
    // N, ...). Other gradients are sums over views.
    bool opacities_for_each_view, sh_for_each_view;
};

// The results of rasterize_views() that its backward pass needs.
class ViewsTape {
  public:
    virtual ~ViewsTape() = default;
    // In the result, centres are (V, N, 2), and backgrounds (V, 3).
    virtual Gradients backward(const py::object& d_color, const py::object& d_alpha,
                               const py::object& d_depth, const ViewsWanted& wanted) = 0;
};

// The settings of views, in addition to gaussians and cameras.
struct ViewsLook {
    double filter_px2;
    bool antialiased;
    std::vector<std::array<double, 3>> backgrounds;  // one element for all views, or
                                                     // one for each
    bool plain_colors;                               // as in DrawLook

    DrawLook of_view(size_t view) const {
        return {.filter_px2 = filter_px2,
                .antialiased = antialiased,
                .background = backgrounds[backgrounds.size() > 1 ? view : 0],
                .plain_colors = plain_colors};
    }
};

// Views that were drawn: (V, H, W, ...). `tape` is null if it was not requested.
struct RasterizedViews {
    py::object color, alpha, depth;
    std::unique_ptr<ViewsTape> tape;
};

// The arrays of views.
template <class T>
struct NewViews {
    py::object color, alpha, depth;  // `depth` is None if not requested
    T *color_plane, *alpha_plane, *depth_plane;

    NewViews(Device device, const BoundCameras& cameras, bool with_depth) : depth(py::none()) {
        const auto count = static_cast<py::ssize_t>(cameras.size());
        const py::ssize_t height = cameras.height();
        const py::ssize_t width = cameras.width();
        color_plane = new_elements<T>(device, {count, height, width, 3}, color);
        alpha_plane = new_elements<T>(device, {count, height, width}, alpha);
        depth_plane = with_depth ? new_elements<T>(device, {count, height, width}, depth) : nullptr;
    }
};

// The arrays of the gradients of views.
template <class T>
struct NewViewsGradients {
    GaussianRows<T> rows;
    CenterGradients<T> centers{};
    T* background;
    T* poses = nullptr;

    // make(shape, object) makes an array like new_elements().
    template <class Make>
    NewViewsGradients(size_t size, int sh_degree, py::ssize_t num_views, const ViewsWanted& wanted,
                      Gradients& made, const Make& make) {
        const auto n = static_cast<py::ssize_t>(size);
        const py::ssize_t bases = num_sh_bases(sh_degree);
        const Shape opacities = wanted.opacities_for_each_view ? Shape{num_views, n} : Shape{n};
        const Shape sh =
            wanted.sh_for_each_view ? Shape{num_views, n, bases, 3} : Shape{n, bases, 3};
        rows = {.means = make({n, 3}, made.means),
                .quats = make({n, 4}, made.quats),
                .scales = make({n, 3}, made.scales),
                .opacities = make(opacities, made.opacities),
                .sh = make(sh, made.sh),
                .size = size,
                .sh_degree = sh_degree};
        background = make({num_views, 3}, made.background);
        if (wanted.centers.sum) centers.sum = make({num_views, n, 2}, made.centers);
        if (wanted.centers.size)
            centers.size =
                reinterpret_cast<CenterSize<T>*>(make({num_views, n, 2}, made.center_sizes));
        if (wanted.poses) poses = make({num_views, 3, 4}, made.poses);
    }
};

// The gradients of the planes of views, each of `num_pixels` pixels.
template <class T>
struct ViewsGradientPlanes {
    GradientPlane<T> color, alpha;
    const T* depth;
    size_t num_pixels;

    ViewsGradientPlanes(Device device, const Shape& shape, const py::object& d_color,
                        const py::object& d_alpha, const py::object& d_depth)
        : color(d_color, "d_color", device, {shape[0], shape[1], shape[2], 3}),
          alpha(d_alpha, "d_alpha", device, shape),
          depth(elements_or_null<const T>(device, d_depth, "d_depth", shape)),
          num_pixels(static_cast<size_t>(shape[1]) * static_cast<size_t>(shape[2])) {}

    PictureGradient<T> of_view(size_t view) const {
        const size_t skipped = view * num_pixels;
        return {color.span.data + 3 * skipped, alpha.span.data + skipped,
                depth == nullptr ? nullptr : depth + skipped};
    }
};

// Implementations of Backend::rasterize_views().
namespace host {
RasterizedViews rasterize_views(const std::vector<Rows>& gaussians, const BoundCameras& cameras,
                                const ViewsLook& look, bool with_depth, bool keep_tape);
}  // namespace host
namespace cuda {
RasterizedViews rasterize_views(const std::vector<Rows>& gaussians, const BoundCameras& cameras,
                                const ViewsLook& look, bool with_depth, bool keep_tape);
}  // namespace cuda

}  // namespace v3dg
