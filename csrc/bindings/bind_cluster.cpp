#include <cmath>
#include <vector>

#include "bindings/args.h"
#include "cluster/cluster.h"

namespace v3dg {

namespace {

py::tuple median_split(const py::array& means, int64_t cluster_size) {
    const Span<const float> values = span_of<const float>(means, "means", {-1, 3});
    if (cluster_size < 1)
        throw py::value_error("cluster_size: expected at least 1, got " + std::to_string(cluster_size));
    const size_t count = values.size / 3;
    if (count > 0xffffffffu)
        throw py::value_error("means: expected fewer than 2^32 rows, got " + std::to_string(count));
    for (size_t i = 0; i < values.size; ++i)
        if (!std::isfinite(values[i]))
            throw py::value_error("means: expected finite values, got " + std::to_string(values[i]) +
                                  " in row " + std::to_string(i / 3));
    const int depth = num_halvings(count, static_cast<size_t>(cluster_size));
    py::array_t<int64_t> order(static_cast<py::ssize_t>(count));
    py::array_t<int64_t> leaf_offset((py::ssize_t(1) << depth) + 1);
    const Span<const Point> points{reinterpret_cast<const Point*>(values.data), count};
    const Span<int64_t> order_span{order.mutable_data(), count};
    const Span<int64_t> offset_span{leaf_offset.mutable_data(), static_cast<size_t>(leaf_offset.size())};
    {
        const py::gil_scoped_release unlocked;
        cpu::median_split(points, depth, order_span, offset_span);
    }
    return py::make_tuple(order, leaf_offset);
}

// Segment boundaries: ascending, from 0 to `last`.
Span<const int64_t> offsets_of(const py::array& offset, const char* name, size_t last) {
    const Span<const int64_t> values = span_of<const int64_t>(offset, name, {-1});
    bool good = values.size > 0 && values[0] == 0 && values[values.size - 1] == static_cast<int64_t>(last);
    for (size_t i = 1; good && i < values.size; ++i) good = values[i - 1] <= values[i];
    if (!good)
        throw py::value_error(std::string(name) + ": expected ascending boundaries from 0 to " +
                              std::to_string(last) + ", got others");
    return values;
}

std::vector<Sphere> spheres_of(const py::array& means, const py::array& radii) {
    const Span<const float> centers = span_of<const float>(means, "means", {-1, 3});
    const size_t count = centers.size / 3;
    const Span<const float> radius = span_of<const float>(radii, "radii", {static_cast<py::ssize_t>(count)});
    std::vector<Sphere> spheres(count);
    for (size_t i = 0; i < count; ++i)
        spheres[i] = {centers[3 * i], centers[3 * i + 1], centers[3 * i + 2], radius[i]};
    return spheres;
}

py::array_t<float> bounding_ball_of_points(const py::array& means, const py::array& radii,
                                           const py::array& offset) {
    const std::vector<Sphere> spheres = spheres_of(means, radii);
    const Span<const int64_t> offsets = offsets_of(offset, "offset", spheres.size());
    py::array_t<float> ball({static_cast<py::ssize_t>(offsets.size - 1), py::ssize_t(4)});
    const Span<Sphere> out{reinterpret_cast<Sphere*>(ball.mutable_data()), offsets.size - 1};
    const py::gil_scoped_release unlocked;
    cpu::bound_spheres({spheres.data(), spheres.size()}, offsets, kNestingMargin, out);
    return ball;
}

py::array_t<float> bounding_ball_of_balls(const py::array& balls, const py::array& offset) {
    const Span<const float> values = span_of<const float>(balls, "balls", {-1, 4});
    const Span<const Sphere> children{reinterpret_cast<const Sphere*>(values.data), values.size / 4};
    const Span<const int64_t> offsets = offsets_of(offset, "offset", children.size);
    py::array_t<float> ball({static_cast<py::ssize_t>(offsets.size - 1), py::ssize_t(4)});
    const Span<Sphere> out{reinterpret_cast<Sphere*>(ball.mutable_data()), offsets.size - 1};
    const py::gil_scoped_release unlocked;
    cpu::bound_spheres(children, offsets, kNestingMargin, out);
    return ball;
}

}  // namespace

void bind_cluster(py::module_& m) {
    using namespace py::literals;
    m.def("median_split", &median_split, "means"_a, "cluster_size"_a,
          "Perfect binary tree of points: (order (N,) int64, leaf_offset (L + 1,) int64).");
    m.def("bounding_ball_of_points", &bounding_ball_of_points, "means"_a, "radii"_a, "offset"_a,
          "Ball (S, 4) around each segment of spheres, with the margin that keeps balls nested.");
    m.def("bounding_ball_of_balls", &bounding_ball_of_balls, "balls"_a, "offset"_a,
          "Ball (S, 4) around each segment of balls (B, 4), with the margin that keeps balls nested.");
}

}  // namespace v3dg
