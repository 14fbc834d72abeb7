// Gaussians without levels, drawn where they are, and their gradients.

#include "bindings/backend.h"
#include "bindings/operations.h"

namespace v3dg {

namespace {

py::object counts_of(const std::optional<RenderCounts>& counts) {
    if (!counts) return py::none();
    return py::dict("in_frustum"_a = counts->in_frustum, "records"_a = counts->records,
                    "entries"_a = counts->entries, "project_seconds"_a = counts->project_seconds,
                    "bin_seconds"_a = counts->bin_seconds,
                    "rasterize_seconds"_a = counts->rasterize_seconds);
}

template <class T>
py::tuple ellipses_of(const Rows& gaussians, const Camera& camera, double filter_px2,
                      bool antialiased, double far_depth, double min_radius_px) {
    const Work work(gaussians.device());
    const auto n = static_cast<py::ssize_t>(gaussians.size());
    const NewArray<T> centers(work.device(), {n, 2}), depths(work.device(), {n}),
        conics(work.device(), {n, 3}), opacities(work.device(), {n});
    const NewArray<int32_t> radii(work.device(), {n, 2});
    const Ellipses<T> out{centers.span.data, depths.span.data, conics.span.data,
                          opacities.span.data, radii.span.data};
    const EllipsesInput<T> in{gaussians.read<T>(),   view_of_world<T>(camera),
                              pinhole_of<T>(camera), T(filter_px2),
                              antialiased,           T(far_depth),
                              T(min_radius_px)};
    {
        const Unlocked unlocked;
        work.backend().ellipses(in, out, work);
    }
    return py::make_tuple(centers.object, depths.object, conics.object, opacities.object,
                          radii.object);
}

py::tuple ellipses(const Rows& gaussians, const BoundCamera& camera, double filter_px2,
                   bool antialiased, double far_depth, double min_radius_px) {
    return gaussians.is_double() ? ellipses_of<double>(gaussians, camera.camera, filter_px2,
                                                       antialiased, far_depth, min_radius_px)
                                 : ellipses_of<float>(gaussians, camera.camera, filter_px2,
                                                      antialiased, far_depth, min_radius_px);
}

}  // namespace

Rasterized rasterize(const Rows& gaussians, const BoundCamera& camera, const DrawLook& look,
                     bool with_depth, bool keep_tape) {
    if (look.plain_colors && gaussians.sh_degree() != 0)
        throw py::value_error("sh: expected shape (N, 1, 3) for plain colours, got degree " +
                              std::to_string(gaussians.sh_degree()));
    return backend_of(gaussians.device())
        .rasterize(gaussians, camera, look, with_depth, keep_tape);
}

void bind_rasterize(py::module_& m) {
    py::class_<Tape>(m, "Tape",
                     "What rasterize leaves for rasterize_backward; it keeps the gaussians.");
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
            return py::make_tuple(made.color, made.alpha, made.depth, counts_of(made.counts),
                                  py::cast(std::move(made.tape)));
        },
        "gaussians"_a, "camera"_a, py::kw_only(), "filter_px2"_a, "antialiased"_a, "background"_a,
        "with_depth"_a, "keep_tape"_a, "plain_colors"_a = false,
        "Draws gaussians where they are and in the precision that they have: (color, alpha, depth "
        "or None, "
        "on "
        "the host counts and times, the tape or None).");
    m.def(
        "rasterize_backward",
        [](Tape& tape, const py::object& d_color, const py::object& d_alpha,
           const py::object& d_depth, bool with_centers, bool with_sizes) {
            const Gradients made =
                tape.backward(d_color, d_alpha, d_depth, {with_centers, with_sizes});
            return py::make_tuple(made.means, made.quats, made.scales, made.opacities, made.sh,
                                  made.background, made.centers, made.center_sizes);
        },
        "tape"_a, "d_color"_a, "d_alpha"_a, "d_depth"_a, "with_centers"_a = false,
        "with_sizes"_a = false,
        "Gradients of means, quats, scales, opacities, sh and background; by the gaussians' "
        "centres on the "
        "image their sum and the sum of their sizes, where they are wanted.");
    m.def("ellipses", &ellipses, "gaussians"_a, "camera"_a, py::kw_only(), "filter_px2"_a,
          "antialiased"_a, "far_depth"_a, "min_radius_px"_a,
          "Where gaussians lie on the image: centres, depths, conics, opacities, radii; zeros for "
          "those that "
          "are not in sight.");
}

}  // namespace v3dg
