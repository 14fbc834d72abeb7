#include "bindings/backend.h"
#include "bindings/operations.h"

namespace v3dg {

namespace {

Span<const int64_t> segments_of(const py::array& offset, const char* name, py::ssize_t length) {
    const Span<const int64_t> s = span_of<const int64_t>(offset, name, {length});
    for (size_t i = 0; i + 1 < s.size; ++i)
        if (s[i] > s[i + 1] || s[i] < 0)
            throw py::value_error(std::string(name) +
                                  ": expected numbers that never decrease, got a smaller one at " +
                                  std::to_string(i + 1));
    return s;
}

// The numbers of gaussians before and after simplification, as segment boundaries.
struct Segments {
    Span<const int64_t> in, out;

    Segments(const py::array& in_offset, const py::array& out_offset, size_t num_rows)
        : in(segments_of(in_offset, "in_offset", -1)),
          out(segments_of(out_offset, "out_offset", static_cast<py::ssize_t>(in.size))) {
        if (in.size == 0 || in[0] != 0 || in[in.size - 1] != static_cast<int64_t>(num_rows) ||
            out[0] != 0)
            throw py::value_error(
                "in_offset, out_offset: expected segments from 0, and in_offset up to " +
                std::to_string(num_rows) + ", the number of gaussians, got other numbers");
        for (size_t g = 0; g + 1 < in.size; ++g) {
            const int64_t num_in = in[g + 1] - in[g];
            const int64_t num_out = out[g + 1] - out[g];
            const int64_t least = num_in > 0 ? 1 : 0;
            if (num_out < least || num_out > num_in)
                throw py::value_error("out_offset: expected " + std::to_string(least) + " to " +
                                      std::to_string(num_in) + " gaussians in segment " +
                                      std::to_string(g) + ", got " + std::to_string(num_out));
        }
    }
    size_t num_out() const { return static_cast<size_t>(out[out.size - 1]); }
};

py::object prune(const Rows& gaussians, const py::array& in_offset, const py::array& out_offset) {
    const GaussianRows<const float> in = gaussians.read<float>();
    const Segments segments(in_offset, out_offset, in.size);
    const Work work(gaussians.device());
    const NewArray<int64_t> kept(gaussians.device(),
                                 {static_cast<py::ssize_t>(segments.num_out())});
    {
        const Unlocked unlocked;
        work.backend().prune(in, segments.in, segments.out, kept.span, work);
    }
    return kept.object;
}

py::tuple merge(const Rows& gaussians, const py::array& in_offset, const py::array& out_offset) {
    const GaussianRows<const float> in = gaussians.read<float>();
    const Segments segments(in_offset, out_offset, in.size);
    const Work work(gaussians.device());
    const NewRows merged(gaussians.device(), segments.num_out(), in.sh_degree);
    {
        const Unlocked unlocked;
        work.backend().merge(in, segments.in, segments.out, merged.rows(), work);
    }
    return merged.arrays();
}

}  // namespace

void bind_simplify(py::module_& m) {
    m.def("prune", &prune, "gaussians"_a, "in_offset"_a, "out_offset"_a,
          "Returns the rows (M,) int64 of the gaussians that are kept, in ascending order.");
    m.def("merge", &merge, "gaussians"_a, "in_offset"_a, "out_offset"_a,
          "Joins pairs of gaussians in each segment until the wanted number is left. Returns "
          "means, quats, scales, opacities, sh.");
}

}  // namespace v3dg
