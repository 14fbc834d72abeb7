#include "bindings/args.h"
#include "bindings/device_args.h"
#include "bindings/render_args.h"
#include "simplify/simplify.h"

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

// The second length of a device array's shape; what is wrong with it is said later.
py::ssize_t num_bases_of(const py::handle& sh) {
    const py::object shape = py::getattr(sh, "shape", py::tuple());
    return py::len(shape) == 3 ? shape[py::int_(1)].cast<py::ssize_t>() : 0;
}

py::array_t<int64_t> prune(const py::array& means, const py::array& scales, const py::array& opacities,
                           const py::array& in_offset, const py::array& out_offset) {
    const Span<const float> opacity = span_of<const float>(opacities, "opacities", {-1});
    const py::ssize_t n = static_cast<py::ssize_t>(opacity.size);
    GaussianRows<const float> in{};
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
    const GaussianRows<const float> in{span_of<const float>(means, "means", {n, 3}).data,
                                       span_of<const float>(quats, "quats", {n, 4}).data,
                                       span_of<const float>(scales, "scales", {n, 3}).data,
                                       span_of<const float>(opacities, "opacities", {n}).data,
                                       span_of<const float>(sh, "sh", {n, bases, 3}).data,
                                       static_cast<size_t>(n),
                                       degree_of_bases(bases, shape_text(sh))};
    const Segments segments(in_offset, out_offset, n);
    const py::ssize_t m = segments.num_out();
    py::array_t<float> out_means({m, py::ssize_t(3)}), out_quats({m, py::ssize_t(4)}),
        out_scales({m, py::ssize_t(3)}), out_opacities(m), out_sh({m, bases, py::ssize_t(3)});
    const GaussianRows<float> out{out_means.mutable_data(),
                                  out_quats.mutable_data(),
                                  out_scales.mutable_data(),
                                  out_opacities.mutable_data(),
                                  out_sh.mutable_data(),
                                  static_cast<size_t>(m),
                                  in.sh_degree};
    {
        const py::gil_scoped_release unlocked;
        cpu::merge(in, segments.in, segments.out, out);
    }
    return py::make_tuple(out_means, out_quats, out_scales, out_opacities, out_sh);
}

}  // namespace

void bind_simplify(py::module_& m) {
    m.def("prune", &prune, "means"_a, "scales"_a, "opacities"_a, "in_offset"_a, "out_offset"_a,
          "Rows (M,) int64 of the gaussians that survive.");
    m.def("merge", &merge, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "in_offset"_a,
          "out_offset"_a, "Rows of the merged gaussians: means, quats, scales, opacities, sh.");
    if constexpr (V3DG_WITH_CUDA) {
        m.def(
            "prune_cuda",
            [](const py::object& means, const py::object& scales, const py::object& opacities,
               const py::array& in_offset, const py::array& out_offset, const py::object& kept,
               uintptr_t stream) {
                const Span<const float> opacity = device_span_of<const float>(opacities, "opacities", {-1});
                const py::ssize_t n = static_cast<py::ssize_t>(opacity.size);
                GaussianRows<const float> in{};
                in.means = device_span_of<const float>(means, "means", {n, 3}).data;
                in.scales = device_span_of<const float>(scales, "scales", {n, 3}).data;
                in.opacities = opacity.data;
                const Segments segments(in_offset, out_offset, n);
                const Span<int64_t> out = device_span_of<int64_t>(kept, "kept", {segments.num_out()});
                const py::gil_scoped_release unlocked;
                cuda::prune(in, segments.in, segments.out, out, reinterpret_cast<cuda::Stream>(stream));
            },
            "means"_a, "scales"_a, "opacities"_a, "in_offset"_a, "out_offset"_a, "kept"_a, "stream"_a,
            "The same on a device: fills `kept`.");
        m.def(
            "merge_cuda",
            [](const py::object& means, const py::object& quats, const py::object& scales,
               const py::object& opacities, const py::object& sh, const py::array& in_offset,
               const py::array& out_offset, const py::object& out_means, const py::object& out_quats,
               const py::object& out_scales, const py::object& out_opacities, const py::object& out_sh,
               uintptr_t stream) {
                const Span<const float> opacity = device_span_of<const float>(opacities, "opacities", {-1});
                const py::ssize_t n = static_cast<py::ssize_t>(opacity.size);
                const py::ssize_t bases = num_bases_of(sh);
                const GaussianRows<const float> in{device_span_of<const float>(means, "means", {n, 3}).data,
                                                   device_span_of<const float>(quats, "quats", {n, 4}).data,
                                                   device_span_of<const float>(scales, "scales", {n, 3}).data,
                                                   opacity.data,
                                                   device_span_of<const float>(sh, "sh", {n, bases, 3}).data,
                                                   static_cast<size_t>(n),
                                                   degree_of_bases(bases, "")};
                const Segments segments(in_offset, out_offset, n);
                const py::ssize_t m = segments.num_out();
                const GaussianRows<float> out{device_span_of<float>(out_means, "out_means", {m, 3}).data,
                                              device_span_of<float>(out_quats, "out_quats", {m, 4}).data,
                                              device_span_of<float>(out_scales, "out_scales", {m, 3}).data,
                                              device_span_of<float>(out_opacities, "out_opacities", {m}).data,
                                              device_span_of<float>(out_sh, "out_sh", {m, bases, 3}).data,
                                              static_cast<size_t>(m),
                                              in.sh_degree};
                const py::gil_scoped_release unlocked;
                cuda::merge(in, segments.in, segments.out, out, reinterpret_cast<cuda::Stream>(stream));
            },
            "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "in_offset"_a, "out_offset"_a,
            "out_means"_a, "out_quats"_a, "out_scales"_a, "out_opacities"_a, "out_sh"_a, "stream"_a,
            "The same on a device: fills out_means, ..., out_sh.");
    }
}

}  // namespace v3dg
