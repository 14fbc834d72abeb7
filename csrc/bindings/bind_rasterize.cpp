// Bindings that draw gaussians without levels on their device, and compute gradients.

#include "bindings/backend.h"
#include "bindings/operations.h"

namespace v3dg {

namespace {

// A picture for Python. `tape` is the input of the backward pass, or None.
struct BoundRasterized {
    py::object color, alpha, depth;
    std::optional<RenderCounts> counts;
    py::object tape;
};

// The ellipses of projected gaussians, for Python.
struct BoundEllipses {
    py::object centers, depths, conics, opacities, radii;
};

template <class T>
BoundEllipses ellipses_of(const Rows& gaussians, const Camera& camera, double filter_px2,
                          bool antialiased, double far_depth, double min_radius_px) {
    const Work work(gaussians.device());
    const auto n = static_cast<py::ssize_t>(gaussians.size());
    const NewArray<T> centers(work.device(), {n, 2}), depths(work.device(), {n}),
        conics(work.device(), {n, 3}), opacities(work.device(), {n});
    const NewArray<int32_t> radii(work.device(), {n, 2});
    const Ellipses<T> out{.centers = centers.span.data,
                          .depths = depths.span.data,
                          .conics = conics.span.data,
                          .opacities = opacities.span.data,
                          .radii = radii.span.data};
    const EllipsesInput<T> in{.rows = gaussians.read<T>(),
                              .view = view_of_world<T>(camera),
                              .camera = camera.intrinsics<T>(),
                              .filter_px2 = T(filter_px2),
                              .antialiased = antialiased,
                              .far_depth = T(far_depth),
                              .min_radius_px = T(min_radius_px)};
    {
        const Unlocked unlocked;
        work.backend().ellipses(in, out, work);
    }
    return {.centers = centers.object,
            .depths = depths.object,
            .conics = conics.object,
            .opacities = opacities.object,
            .radii = radii.object};
}

BoundEllipses ellipses(const Rows& gaussians, const BoundCamera& camera, double filter_px2,
                       bool antialiased, double far_depth, double min_radius_px) {
    return gaussians.is_double() ? ellipses_of<double>(gaussians, camera.camera, filter_px2,
                                                       antialiased, far_depth, min_radius_px)
                                 : ellipses_of<float>(gaussians, camera.camera, filter_px2,
                                                      antialiased, far_depth, min_radius_px);
}

}  // namespace

void check_plain_colors(const Rows& gaussians) {
    if (gaussians.sh_degree() != 0)
        refuse_value("sh", "expected shape (N, 1, 3) for plain colours, got degree " +
                               std::to_string(gaussians.sh_degree()));
}

Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                     bool with_depth, bool keep_tape) {
    if (look.plain_colors) check_plain_colors(gaussians);
    return backend_of(gaussians.device()).rasterize(gaussians, camera, look, with_depth, keep_tape);
}

void bind_rasterize(py::module_& m) {
    py::class_<Tape>(
        m, "Tape",
        "The results of rasterize() that rasterize_backward() needs. It keeps the gaussians "
        "alive.");
    py::class_<RenderCounts>(m, "RenderCounts",
                             "The statistics of a picture that was drawn on "
                             "the host.")
        .def_readonly("in_frustum", &RenderCounts::in_frustum)
        .def_readonly("records", &RenderCounts::records)
        .def_readonly("entries", &RenderCounts::entries)
        .def_readonly("project_seconds", &RenderCounts::project_seconds)
        .def_readonly("bin_seconds", &RenderCounts::bin_seconds)
        .def_readonly("rasterize_seconds", &RenderCounts::rasterize_seconds);
    py::class_<BoundRasterized>(m, "Rasterized", "A picture of gaussians without levels.")
        .def_readonly("color", &BoundRasterized::color, "(H, W, 3).")
        .def_readonly("alpha", &BoundRasterized::alpha, "(H, W).")
        .def_readonly("depth", &BoundRasterized::depth, "(H, W), or None.")
        .def_readonly("counts", &BoundRasterized::counts,
                      "The statistics; None if the picture was "
                      "drawn on a device.")
        .def_readonly("tape", &BoundRasterized::tape,
                      "The tape for the backward pass; None if "
                      "not requested.");
    py::class_<Gradients>(m, "Gradients",
                          "The gradients of a picture with respect to its "
                          "gaussians.")
        .def_readonly("means", &Gradients::means)
        .def_readonly("quats", &Gradients::quats)
        .def_readonly("scales", &Gradients::scales)
        .def_readonly("opacities", &Gradients::opacities)
        .def_readonly("sh", &Gradients::sh)
        .def_readonly("background", &Gradients::background)
        .def_readonly("poses", &Gradients::poses,
                      "(V, 3, 4), with respect to the world-to-camera matrices of V views, or "
                      "None.")
        .def_readonly("centers", &Gradients::centers,
                      "(N, 2), by the centres on the image, or None.")
        .def_readonly(
            "center_sizes", &Gradients::center_sizes,
            "(N, 2), sums over pixels of absolute gradients with respect to the centres, or None.");
    py::class_<BoundEllipses>(
        m, "Ellipses",
        "The ellipses of projected gaussians. All values of an invisible gaussian"
        " are zero.")
        .def_readonly("centers", &BoundEllipses::centers, "(N, 2), px.")
        .def_readonly("depths", &BoundEllipses::depths, "(N,).")
        .def_readonly("conics", &BoundEllipses::conics, "(N, 3).")
        .def_readonly("opacities", &BoundEllipses::opacities, "(N,).")
        .def_readonly("radii", &BoundEllipses::radii, "(N, 2) int32, px.");
    m.def(
        "rasterize",
        [](const Rows& gaussians, const BoundCamera& camera, double filter_px2, bool antialiased,
           const std::array<double, 3>& background, bool with_depth, bool keep_tape,
           bool plain_colors) {
            const DrawLook look{.filter_px2 = filter_px2,
                                .antialiased = antialiased,
                                .background = background,
                                .plain_colors = plain_colors};
            Rasterized made = rasterize(gaussians, camera, look, with_depth, keep_tape);
            return BoundRasterized{.color = made.color,
                                   .alpha = made.alpha,
                                   .depth = made.depth,
                                   .counts = made.counts,
                                   .tape = py::cast(std::move(made.tape))};
        },
        "gaussians"_a, "camera"_a, py::kw_only(), "filter_px2"_a, "antialiased"_a, "background"_a,
        "with_depth"_a, "keep_tape"_a, "plain_colors"_a = false,
        "Draws gaussians on their device and in their precision.");
    m.def(
        "rasterize_backward",
        [](Tape& tape, const py::object& d_color, const py::object& d_alpha,
           const py::object& d_depth, bool with_centers, bool with_sizes) {
            return tape.backward(d_color, d_alpha, d_depth,
                                 {.sum = with_centers, .size = with_sizes});
        },
        "tape"_a, "d_color"_a, "d_alpha"_a, "d_depth"_a, "with_centers"_a = false,
        "with_sizes"_a = false,
        "Computes the gradients of gaussians from the gradients of a "
        "picture.");
    m.def("ellipses", &ellipses, "gaussians"_a, "camera"_a, py::kw_only(), "filter_px2"_a,
          "antialiased"_a, "far_depth"_a, "min_radius_px"_a,
          "Projects gaussians to ellipses on the "
          "image.");
}

}  // namespace v3dg
