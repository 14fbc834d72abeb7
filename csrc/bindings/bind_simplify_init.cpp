#include "bindings/args.h"
#include "simplify_init/simplify_init.h"

namespace v3dg {

using namespace py::literals;

static Span<const int64_t> segments(const py::array& offset, const char* name, py::ssize_t length) {
    const Span<const int64_t> s = span_of<const int64_t>(offset, name, {length});
    for (size_t i = 0; i + 1 < s.size; ++i)
        if (s[i] > s[i + 1] || s[i] < 0)
            throw py::value_error(std::string(name) + ": expected numbers that do not fall");
    return s;
}

// Runs `method(rows in, in_offset, out_offset, rows out)` on checked arrays and returns the new rows.
template <class Method>
static py::tuple simplify(const py::array& means, const py::array& quats, const py::array& scales,
                          const py::array& opacities, const py::array& sh, const py::array& in_offset,
                          const py::array& out_offset, const Method& method) {
    const py::ssize_t n = opacities.ndim() == 1 ? opacities.shape(0) : 0;
    const py::ssize_t bases = sh.ndim() == 3 ? sh.shape(1) : 0;
    const RowsIn in{span_of<const float>(means, "means", {n, 3}).data,
                    span_of<const float>(quats, "quats", {n, 4}).data,
                    span_of<const float>(scales, "scales", {n, 3}).data,
                    span_of<const float>(opacities, "opacities", {n}).data,
                    span_of<const float>(sh, "sh", {n, bases, 3}).data,
                    static_cast<int>(3 * bases)};
    const Span<const int64_t> from = segments(in_offset, "in_offset", -1);
    const Span<const int64_t> to = segments(out_offset, "out_offset", static_cast<py::ssize_t>(from.size));
    if (from.size == 0 || from[0] != 0 || from[from.size - 1] != n || to[0] != 0)
        throw py::value_error(
            "in_offset, out_offset: expected segments from 0, in_offset up to the number of gaussians");
    for (size_t g = 0; g + 1 < from.size; ++g)
        if (to[g + 1] - to[g] > from[g + 1] - from[g] || (to[g + 1] == to[g] && from[g + 1] > from[g]))
            throw py::value_error("out_offset: expected 1 to as many gaussians as come in, segment " +
                                  std::to_string(g) + " has others");
    const py::ssize_t m = to[to.size - 1];
    py::array_t<float> out_means({m, py::ssize_t(3)}), out_quats({m, py::ssize_t(4)}),
        out_scales({m, py::ssize_t(3)}), out_opacities(m), out_sh({m, bases, py::ssize_t(3)});
    const RowsOut out{out_means.mutable_data(), out_quats.mutable_data(), out_scales.mutable_data(),
                      out_opacities.mutable_data(), out_sh.mutable_data()};
    {
        py::gil_scoped_release unlocked;
        method(in, from, to, out);
    }
    return py::make_tuple(out_means, out_quats, out_scales, out_opacities, out_sh);
}

void bind_simplify_init(py::module_& m) {
    m.def(
        "prune",
        [](const py::array& means, const py::array& quats, const py::array& scales,
           const py::array& opacities, const py::array& sh, const py::array& in_offset,
           const py::array& out_offset, float growth) {
            return simplify(means, quats, scales, opacities, sh, in_offset, out_offset,
                            [growth](const RowsIn& in, auto from, auto to, const RowsOut& out) {
                                prune(in, from, to, growth, out);
                            });
        },
        "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "in_offset"_a, "out_offset"_a, "growth"_a);
    m.def(
        "merge",
        [](const py::array& means, const py::array& quats, const py::array& scales,
           const py::array& opacities, const py::array& sh, const py::array& in_offset,
           const py::array& out_offset) {
            return simplify(
                means, quats, scales, opacities, sh, in_offset, out_offset,
                [](const RowsIn& in, auto from, auto to, const RowsOut& out) { merge(in, from, to, out); });
        },
        "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "in_offset"_a, "out_offset"_a);
}

}  // namespace v3dg
