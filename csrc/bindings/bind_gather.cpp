#include <vector>

#include "bindings/args.h"
#include "bindings/device_args.h"
#include "bindings/render_args.h"
#include "gather/gather.h"

namespace v3dg {

using namespace py::literals;

namespace {

// Rows (means, quats, scales, opacities, sh) after checks, and how many; from the host or a device.
template <class Rows, class SpanOf>
Rows rows_of(const py::sequence& arrays, py::ssize_t num, py::ssize_t bases, const SpanOf& span) {
    if (py::len(arrays) != 5)
        throw py::value_error("rows: expected means, quats, scales, opacities, sh, got " +
                              std::to_string(py::len(arrays)) + " arrays");
    Rows rows{};
    rows.means = span(arrays[0], "means", {num, 3}).data;
    rows.quats = span(arrays[1], "quats", {num, 4}).data;
    rows.scales = span(arrays[2], "scales", {num, 3}).data;
    rows.opacities = span(arrays[3], "opacities", {num}).data;
    rows.sh = span(arrays[4], "sh", {num, bases, 3}).data;
    return rows;
}

template <class T>
Span<T> host_span(const py::object& array, const char* name, std::initializer_list<py::ssize_t> shape) {
    return span_of<T>(array.cast<py::array>(), name, shape);
}

// The arguments of one call; `input` borrows from them.
struct Arguments {
    std::vector<GaussianRows<const float>> bundles;
    std::vector<int64_t> num_rows;
    GatherInput input;
};

template <class SpanOf>
Arguments arguments_of(const py::list& bundles, const py::array& bundle, const py::array& positions,
                       const py::array& rotations, const py::array& quaternions, const py::array& scales,
                       const py::array& bands, const py::array& instance, const py::array& first_row,
                       const py::array& offset, const SpanOf& span) {
    Arguments arguments;
    bool has_bands = false;
    for (const py::handle item : bundles) {
        const py::sequence arrays = py::reinterpret_borrow<py::sequence>(item);
        const py::tuple shape = py::object(arrays[4]).attr("shape");
        if (shape.size() != 3)
            throw py::value_error("sh: expected three dimensions, got " + std::to_string(shape.size()));
        const py::ssize_t num = shape[0].cast<py::ssize_t>(), bases = shape[1].cast<py::ssize_t>();
        GaussianRows<const float> rows = rows_of<GaussianRows<const float>>(arrays, num, bases, span);
        rows.sh_degree = degree_of_bases(bases, py::str(shape).cast<std::string>());
        rows.size = static_cast<size_t>(num);
        has_bands = has_bands || bases > 1;
        arguments.bundles.push_back(rows);
        arguments.num_rows.push_back(num);
    }
    GatherInput& in = arguments.input;
    in.bundles = {arguments.bundles.data(), arguments.bundles.size()};
    in.bundle = span_of<const int32_t>(bundle, "bundle", {-1});
    const py::ssize_t count = static_cast<py::ssize_t>(in.bundle.size);
    in.position = span_of<const double>(positions, "positions", {count, 3});
    in.rotation = span_of<const double>(rotations, "rotations", {count, 3, 3});
    in.quaternion = span_of<const double>(quaternions, "quaternions", {count, 4});
    in.scale = span_of<const double>(scales, "scales", {count});
    in.bands = span_of<const double>(bands, "bands", {has_bands ? count : -1, kBandsSize});
    in.instance = span_of<const int32_t>(instance, "instance", {-1});
    const py::ssize_t num_clusters = static_cast<py::ssize_t>(in.instance.size);
    in.first_row = span_of<const int64_t>(first_row, "first_row", {num_clusters});
    in.offset = span_of<const int64_t>(offset, "offset", {num_clusters + 1});
    for (const int32_t b : in.bundle)
        if (b < 0 || static_cast<size_t>(b) >= in.bundles.size)
            throw py::value_error("bundle: expected one below " + std::to_string(in.bundles.size) + ", got " +
                                  std::to_string(b));
    if (in.offset[0] != 0) throw py::value_error("offset: expected boundaries from 0");
    for (size_t s = 0; s < in.instance.size; ++s) {
        const int32_t i = in.instance[s];
        if (i < 0 || i >= count)
            throw py::value_error("instance: expected one below " + std::to_string(count) + ", got " +
                                  std::to_string(i));
        const int64_t rows = arguments.num_rows[in.bundle[i]], size = in.offset[s + 1] - in.offset[s];
        if (size < 0 || in.first_row[s] < 0 || in.first_row[s] > rows - size)
            throw py::value_error("first_row, offset: expected rows of the bundle, cluster " +
                                  std::to_string(s) + " has others");
    }
    return arguments;
}

py::tuple gather(const py::list& bundles, const py::array& bundle, const py::array& positions,
                 const py::array& rotations, const py::array& quaternions, const py::array& scales,
                 const py::array& bands, const py::array& instance, const py::array& first_row,
                 const py::array& offset, int num_bases) {
    const Arguments arguments = arguments_of(bundles, bundle, positions, rotations, quaternions, scales,
                                             bands, instance, first_row, offset, host_span<const float>);
    const GatherInput& in = arguments.input;
    const py::ssize_t n = in.offset[in.instance.size];
    py::array_t<float> means({n, py::ssize_t(3)}), quats({n, py::ssize_t(4)}), sizes({n, py::ssize_t(3)}),
        opacities(n), sh({n, py::ssize_t(num_bases), py::ssize_t(3)});
    const GaussianRows<float> out{means.mutable_data(),          quats.mutable_data(), sizes.mutable_data(),
                                  opacities.mutable_data(),      sh.mutable_data(),    static_cast<size_t>(n),
                                  degree_of_bases(num_bases, "")};
    {
        const py::gil_scoped_release unlocked;
        cpu::gather(in, out);
    }
    return py::make_tuple(means, quats, sizes, opacities, sh);
}

}  // namespace

void bind_gather(py::module_& m) {
    m.def("gather", &gather, "bundles"_a, "bundle"_a, "positions"_a, "rotations"_a, "quaternions"_a,
          "scales"_a, "bands"_a, "instance"_a, "first_row"_a, "offset"_a, "num_bases"_a,
          "Rows of clusters of instances in the world: means, quats, scales, opacities, sh.");
    if constexpr (V3DG_WITH_CUDA) {
        m.def(
            "gather_cuda",
            [](const py::list& bundles, const py::array& bundle, const py::array& positions,
               const py::array& rotations, const py::array& quaternions, const py::array& scales,
               const py::array& bands, const py::array& instance, const py::array& first_row,
               const py::array& offset, int num_bases, const py::sequence& rows, uintptr_t stream) {
                const Arguments arguments =
                    arguments_of(bundles, bundle, positions, rotations, quaternions, scales, bands, instance,
                                 first_row, offset, device_span_of<const float>);
                const GatherInput& in = arguments.input;
                GaussianRows<float> out = rows_of<GaussianRows<float>>(rows, in.offset[in.instance.size],
                                                                       num_bases, device_span_of<float>);
                out.sh_degree = degree_of_bases(num_bases, "");
                const py::gil_scoped_release unlocked;
                cuda::gather(in, out, reinterpret_cast<cuda::Stream>(stream));
            },
            "bundles"_a, "bundle"_a, "positions"_a, "rotations"_a, "quaternions"_a, "scales"_a, "bands"_a,
            "instance"_a, "first_row"_a, "offset"_a, "num_bases"_a, "rows"_a, "stream"_a,
            "The same on a device: fills `rows`.");
    }
}

}  // namespace v3dg
