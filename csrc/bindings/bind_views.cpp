// Bindings that draw gaussians without levels for several cameras, and compute gradients.

#include "bindings/backend.h"
#include "bindings/operations.h"

namespace v3dg {

namespace {

// Views for Python. `tape` is the input of the backward pass, or None.
struct BoundViews {
    py::object color, alpha, depth;
    py::object tape;
};

void check_views(const std::vector<Rows>& gaussians, const BoundCameras& cameras,
                 const ViewsLook& look) {
    const size_t num_views = cameras.size();
    if (num_views == 0) refuse_value("cameras", "expected at least one, got none");
    if (cameras.device() != kHost || !cameras.lenses().empty())
        refuse_value("cameras", "expected pinholes whose arrays are on the CPU");
    const auto fits = [num_views](size_t count) { return count == 1 || count == num_views; };
    if (!fits(gaussians.size())) refuse_value("gaussians", "expected one, or one for each camera");
    if (!fits(look.backgrounds.size()))
        refuse_value("backgrounds", "expected one, or one for each camera");
    for (const Rows& rows : gaussians) {
        const Rows& first = gaussians[0];
        const bool is_alike = rows.size() == first.size() && rows.device() == first.device() &&
                              rows.sh_degree() == first.sh_degree() &&
                              rows.is_double() == first.is_double();
        if (!is_alike) refuse_value("gaussians", "expected as many of one kind for each camera");
    }
    if (look.plain_colors) check_plain_colors(gaussians[0]);
}

template <class T>
py::tuple ellipses_of(const Rows& gaussians, const BoundCameras& cameras, double filter_px2,
                      bool antialiased, double far_depth, double min_radius_px) {
    const Work work(gaussians.device());
    const std::vector<Camera> views = cameras.on_host();
    const auto v = static_cast<py::ssize_t>(views.size());
    const auto n = static_cast<py::ssize_t>(gaussians.size());
    const NewArray<T> centers(work.device(), {v, n, 2});
    const NewArray<T> depths(work.device(), {v, n});
    const NewArray<T> conics(work.device(), {v, n, 3});
    const NewArray<T> opacities(work.device(), {v, n});
    const NewArray<int32_t> radii(work.device(), {v, n, 2});
    {
        const Unlocked unlocked;
        for (size_t view = 0; view < views.size(); ++view) {
            const size_t skipped = view * gaussians.size();
            const EllipsesInput<T> in{.rows = gaussians.read<T>(),
                                      .view = view_of_world<T>(views[view]),
                                      .camera = views[view].template intrinsics<T>(),
                                      .filter_px2 = T(filter_px2),
                                      .antialiased = antialiased,
                                      .far_depth = T(far_depth),
                                      .min_radius_px = T(min_radius_px)};
            const Ellipses<T> out{.centers = centers.span.data + 2 * skipped,
                                  .depths = depths.span.data + skipped,
                                  .conics = conics.span.data + 3 * skipped,
                                  .opacities = opacities.span.data + skipped,
                                  .radii = radii.span.data + 2 * skipped};
            work.backend().ellipses(in, out, work);
        }
    }
    return py::make_tuple(centers.object, depths.object, conics.object, opacities.object,
                          radii.object);
}

}  // namespace

void bind_views(py::module_& m) {
    py::class_<ViewsTape>(
        m, "ViewsTape",
        "The results of rasterize_views() that rasterize_views_backward() needs. It keeps the "
        "gaussians alive.");
    py::class_<BoundViews>(m, "RasterizedViews", "Pictures of gaussians without levels.")
        .def_readonly("color", &BoundViews::color, "(V, H, W, 3).")
        .def_readonly("alpha", &BoundViews::alpha, "(V, H, W).")
        .def_readonly("depth", &BoundViews::depth, "(V, H, W), or None.")
        .def_readonly("tape", &BoundViews::tape,
                      "The tape for the backward pass; None if not requested.");
    m.def(
        "rasterize_views",
        [](const std::vector<Rows>& gaussians, const BoundCameras& cameras, double filter_px2,
           bool antialiased, std::vector<std::array<double, 3>> backgrounds, bool with_depth,
           bool keep_tape, bool plain_colors) {
            const ViewsLook look{.filter_px2 = filter_px2,
                                 .antialiased = antialiased,
                                 .backgrounds = std::move(backgrounds),
                                 .plain_colors = plain_colors};
            check_views(gaussians, cameras, look);
            RasterizedViews made =
                backend_of(gaussians[0].device())
                    .rasterize_views(gaussians, cameras, look, with_depth, keep_tape);
            return BoundViews{.color = made.color,
                              .alpha = made.alpha,
                              .depth = made.depth,
                              .tape = py::cast(std::move(made.tape))};
        },
        "gaussians"_a, "cameras"_a, py::kw_only(), "filter_px2"_a, "antialiased"_a, "backgrounds"_a,
        "with_depth"_a, "keep_tape"_a, "plain_colors"_a = false,
        "Draws gaussians for several cameras. `gaussians` are those of all cameras, or of each "
        "camera.");
    m.def(
        "rasterize_views_backward",
        [](ViewsTape& tape, const py::object& d_color, const py::object& d_alpha,
           const py::object& d_depth, bool with_centers, bool with_sizes, bool with_poses,
           bool opacities_for_each_view, bool sh_for_each_view) {
            return tape.backward(d_color, d_alpha, d_depth,
                                 {.centers = {.sum = with_centers, .size = with_sizes},
                                  .poses = with_poses,
                                  .opacities_for_each_view = opacities_for_each_view,
                                  .sh_for_each_view = sh_for_each_view});
        },
        "tape"_a, "d_color"_a, "d_alpha"_a, "d_depth"_a, py::kw_only(), "with_centers"_a = false,
        "with_sizes"_a = false, "with_poses"_a = false, "opacities_for_each_view"_a = false,
        "sh_for_each_view"_a = false,
        "Computes the gradients of gaussians and poses from the gradients of pictures.");
    m.def(
        "ellipses_of_views",
        [](const Rows& gaussians, const BoundCameras& cameras, double filter_px2, bool antialiased,
           double far_depth, double min_radius_px) {
            if (gaussians.is_double())
                return ellipses_of<double>(gaussians, cameras, filter_px2, antialiased, far_depth,
                                           min_radius_px);
            return ellipses_of<float>(gaussians, cameras, filter_px2, antialiased, far_depth,
                                      min_radius_px);
        },
        "gaussians"_a, "cameras"_a, py::kw_only(), "filter_px2"_a, "antialiased"_a, "far_depth"_a,
        "min_radius_px"_a,
        "Projects gaussians to the ellipses on the image of each camera: centres, depths, conics, "
        "opacities and radii.");
}

}  // namespace v3dg
