#include "bindings/args.h"
#include "bindings/device_args.h"
#include "simplify_init/simplify_init.h"

namespace v3dg {

using namespace py::literals;

namespace {

Span<const int64_t> segments(const py::array& offset, const char* name, py::ssize_t length) {
    const Span<const int64_t> s = span_of<const int64_t>(offset, name, {length});
    for (size_t i = 0; i + 1 < s.size; ++i)
        if (s[i] > s[i + 1] || s[i] < 0)
            throw py::value_error(std::string(name) + ": expected numbers that do not fall");
    return s;
}

// How `num_rows` gaussians are taken to fewer, segment by segment.
struct Segments {
    Span<const int64_t> in, out;

    Segments(const py::array& in_offset, const py::array& out_offset, py::ssize_t num_rows)
        : in(segments(in_offset, "in_offset", -1)),
          out(segments(out_offset, "out_offset", static_cast<py::ssize_t>(in.size))) {
        if (in.size == 0 || in[0] != 0 || in[in.size - 1] != num_rows || out[0] != 0)
            throw py::value_error(
                "in_offset, out_offset: expected segments from 0, in_offset up to the number of gaussians");
        for (size_t g = 0; g + 1 < in.size; ++g)
            if (out[g + 1] - out[g] > in[g + 1] - in[g] || (out[g + 1] == out[g] && in[g + 1] > in[g]))
                throw py::value_error("out_offset: expected 1 to as many gaussians as come in, segment " +
                                      std::to_string(g) + " has others");
    }
    py::ssize_t num_out() const { return out[out.size - 1]; }
};

py::array_t<int64_t> prune(const py::array& means, const py::array& scales, const py::array& opacities,
                           const py::array& in_offset, const py::array& out_offset) {
    const Span<const float> opacity = span_of<const float>(opacities, "opacities", {-1});
    const py::ssize_t n = static_cast<py::ssize_t>(opacity.size);
    RowsIn in{};
    in.means = span_of<const float>(means, "means", {n, 3}).data;
    in.scales = span_of<const float>(scales, "scales", {n, 3}).data;
    in.opacities = opacity.data;
    const Segments segments(in_offset, out_offset, n);
    py::array_t<int64_t> kept(segments.num_out());
    const Span<int64_t> out{kept.mutable_data(), static_cast<size_t>(kept.size())};
    const py::gil_scoped_release unlocked;
    cpu::prune(in, segments.in, segments.out, out);
    return kept;
}

py::tuple merge(const py::array& means, const py::array& quats, const py::array& scales,
                const py::array& opacities, const py::array& sh, const py::array& in_offset,
                const py::array& out_offset) {
    const py::ssize_t n = opacities.ndim() == 1 ? opacities.shape(0) : 0;
    const py::ssize_t bases = sh.ndim() == 3 ? sh.shape(1) : 0;
    const RowsIn in{span_of<const float>(means, "means", {n, 3}).data,
                    span_of<const float>(quats, "quats", {n, 4}).data,
                    span_of<const float>(scales, "scales", {n, 3}).data,
                    span_of<const float>(opacities, "opacities", {n}).data,
                    span_of<const float>(sh, "sh", {n, bases, 3}).data,
                    static_cast<int>(3 * bases)};
    const Segments segments(in_offset, out_offset, n);
    const py::ssize_t m = segments.num_out();
    py::array_t<float> out_means({m, py::ssize_t(3)}), out_quats({m, py::ssize_t(4)}),
        out_scales({m, py::ssize_t(3)}), out_opacities(m), out_sh({m, bases, py::ssize_t(3)});
    const RowsOut out{out_means.mutable_data(), out_quats.mutable_data(), out_scales.mutable_data(),
                      out_opacities.mutable_data(), out_sh.mutable_data()};
    {
        const py::gil_scoped_release unlocked;
        cpu::merge(in, segments.in, segments.out, out);
    }
    return py::make_tuple(out_means, out_quats, out_scales, out_opacities, out_sh);
}

}  // namespace

void bind_simplify_init(py::module_& m) {
    m.def("prune", &prune, "means"_a, "scales"_a, "opacities"_a, "in_offset"_a, "out_offset"_a,
          "Rows (M,) int64 of the gaussians that survive.");
    m.def("merge", &merge, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "in_offset"_a,
          "out_offset"_a, "Rows of the merged gaussians: means, quats, scales, opacities, sh.");
}

}  // namespace v3dg
