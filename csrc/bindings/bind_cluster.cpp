#include <cmath>

#include "bindings/args.h"
#include "bindings/device_args.h"
#include "cluster/cluster.h"

namespace v3dg {

namespace {

// Segment boundaries: ascending, from 0 to `last`.
Span<const int64_t> offsets_of(const py::array& offset, size_t last) {
    const Span<const int64_t> values = span_of<const int64_t>(offset, "offset", {-1});
    bool good = values.size > 0 && values[0] == 0 && values[values.size - 1] == static_cast<int64_t>(last);
    for (size_t i = 1; good && i < values.size; ++i) good = values[i - 1] <= values[i];
    if (!good)
        throw py::value_error("offset: expected ascending boundaries from 0 to " + std::to_string(last) +
                              ", got others");
    return values;
}

Span<const Point> points_of(Span<const float> means) {
    const size_t count = means.size / 3;
    if (count > 0xffffffffu)
        throw py::value_error("means: expected fewer than 2^32 rows, got " + std::to_string(count));
    return {reinterpret_cast<const Point*>(means.data), count};
}

void check_finite(Span<const float> means) {
    for (size_t i = 0; i < means.size; ++i)
        if (!std::isfinite(means[i]))
            throw py::value_error("means: expected finite values, got " + std::to_string(means[i]) +
                                  " in row " + std::to_string(i / 3));
}

// The leaves' boundaries of a split, not yet filled in.
py::array_t<int64_t> leaf_offset_of(Span<const int64_t> offset, int depth) {
    constexpr int kDeepest = 32;  // as deep as 2^32 points go
    if (depth < 0 || depth > kDeepest)
        throw py::value_error("depth: expected 0 to 32, got " + std::to_string(depth));
    return py::array_t<int64_t>(static_cast<py::ssize_t>(((offset.size - 1) << depth) + 1));
}

Span<int64_t> span_of_new(py::array_t<int64_t>& array) {
    return {array.mutable_data(), static_cast<size_t>(array.size())};
}

int halvings(int64_t count, int64_t cluster_size) {
    if (cluster_size < 1)
        throw py::value_error("cluster_size: expected at least 1, got " + std::to_string(cluster_size));
    return num_halvings(static_cast<size_t>(count), static_cast<size_t>(cluster_size));
}

py::tuple median_split(const py::array& means, const py::array& offset, int depth) {
    const Span<const float> values = span_of<const float>(means, "means", {-1, 3});
    const Span<const Point> points = points_of(values);
    check_finite(values);
    const Span<const int64_t> offsets = offsets_of(offset, points.size);
    py::array_t<int64_t> order(static_cast<py::ssize_t>(points.size));
    py::array_t<int64_t> leaf_offset = leaf_offset_of(offsets, depth);
    const Span<int64_t> order_span = span_of_new(order), leaf_span = span_of_new(leaf_offset);
    {
        const py::gil_scoped_release unlocked;
        cpu::median_split(points, offsets, depth, order_span, leaf_span);
    }
    return py::make_tuple(order, leaf_offset);
}

Span<const Ball> spheres_of(Span<const float> rows) {
    return {reinterpret_cast<const Ball*>(rows.data), rows.size / 4};
}

py::array_t<float> bound_spheres(const py::array& spheres, const py::array& offset) {
    const Span<const Ball> in = spheres_of(span_of<const float>(spheres, "spheres", {-1, 4}));
    const Span<const int64_t> offsets = offsets_of(offset, in.size);
    py::array_t<float> ball({static_cast<py::ssize_t>(offsets.size - 1), py::ssize_t(4)});
    const Span<Ball> out{reinterpret_cast<Ball*>(ball.mutable_data()), offsets.size - 1};
    const py::gil_scoped_release unlocked;
    cpu::bound_spheres(in, offsets, kNestingMargin, out);
    return ball;
}

}  // namespace

void bind_cluster(py::module_& m) {
    using namespace py::literals;
    m.def("num_halvings", &halvings, "count"_a, "cluster_size"_a,
          "How often points are halved until no part holds more than cluster_size.");
    m.def("median_split", &median_split, "means"_a, "offset"_a, "depth"_a,
          "Perfect binary tree of each segment's points: (order (N,) int64, leaf_offset (L + 1,) int64).");
    m.def("bound_spheres", &bound_spheres, "spheres"_a, "offset"_a,
          "Ball (S, 4) around each segment of spheres (N, 4), with the margin that keeps balls nested.");
    if constexpr (V3DG_WITH_CUDA) {
        m.def(
            "median_split_cuda",
            [](const py::object& means, const py::array& offset, int depth, const py::object& order,
               uintptr_t stream) {
                const Span<const Point> points =
                    points_of(device_span_of<const float>(means, "means", {-1, 3}));
                const Span<const int64_t> offsets = offsets_of(offset, points.size);
                const Span<int64_t> out =
                    device_span_of<int64_t>(order, "order", {static_cast<py::ssize_t>(points.size)});
                py::array_t<int64_t> leaf_offset = leaf_offset_of(offsets, depth);
                const Span<int64_t> leaf_span = span_of_new(leaf_offset);
                {
                    const py::gil_scoped_release unlocked;
                    cuda::median_split(points, offsets, depth, out, leaf_span,
                                       reinterpret_cast<cuda::Stream>(stream));
                }
                return leaf_offset;
            },
            "means"_a, "offset"_a, "depth"_a, "order"_a, "stream"_a,
            "The same on a device: fills `order` and returns leaf_offset.");
        m.def(
            "bound_spheres_cuda",
            [](const py::object& spheres, const py::array& offset, const py::object& ball, uintptr_t stream) {
                const Span<const Ball> in =
                    spheres_of(device_span_of<const float>(spheres, "spheres", {-1, 4}));
                const Span<const int64_t> offsets = offsets_of(offset, in.size);
                const Span<float> out =
                    device_span_of<float>(ball, "ball", {static_cast<py::ssize_t>(offsets.size - 1), 4});
                const py::gil_scoped_release unlocked;
                cuda::bound_spheres(in, offsets, kNestingMargin,
                                    {reinterpret_cast<Ball*>(out.data), offsets.size - 1},
                                    reinterpret_cast<cuda::Stream>(stream));
            },
            "spheres"_a, "offset"_a, "ball"_a, "stream"_a, "The same on a device: fills `ball`.");
    }
}

}  // namespace v3dg
