// Bindings of clustering: median split, bounds, and checks of a bundle's tables.

#include <cmath>
#include <map>

#include "bindings/backend.h"
#include "bindings/operations.h"
#include "cluster/check_tables.h"
#include "cluster/examine.h"
#include "cluster/morton.h"

namespace v3dg {

namespace {

int halvings(int64_t count, int64_t cluster_size) {
    if (cluster_size < 1)
        throw py::value_error("cluster_size: expected at least 1, got " +
                              std::to_string(cluster_size));
    return num_halvings(static_cast<size_t>(count), static_cast<size_t>(cluster_size));
}

void check_finite(Span<const float> means) {
    for (size_t i = 0; i < means.size; ++i)
        if (!std::isfinite(means[i]))
            throw py::value_error("means: expected finite values, got " + std::to_string(means[i]) +
                                  " in row " + std::to_string(i / 3));
}

py::tuple median_split(const py::object& means, const py::array& offset, int depth, int64_t unit) {
    constexpr int kDeepest = 32;  // splits up to 2^32 points
    const Device device = device_of(means, "means");
    const Span<const float> values = span_on<const float>(device, means, "means", {-1, 3});
    const Span<const Point> points{reinterpret_cast<const Point*>(values.data), values.size / 3};
    if (points.size > 0xffffffffu)
        throw py::value_error("means: expected fewer than 2^32 rows, got " +
                              std::to_string(points.size));
    const Span<const int64_t> offsets = offsets_of(offset, points.size);
    if (depth < 0 || depth > kDeepest)
        throw py::value_error("depth: expected 0 to 32, got " + std::to_string(depth));
    if (unit < 1) throw py::value_error("unit: expected at least 1, got " + std::to_string(unit));
    const Work work(device);
    if (work.backend().traits.host_reads_arrays) check_finite(values);
    const NewArray<int64_t> order(device, {static_cast<py::ssize_t>(points.size)});
    const NewArray<int64_t> leaf_offset(
        {}, {static_cast<py::ssize_t>(((offsets.size - 1) << depth) + 1)});
    {
        const Unlocked unlocked;
        work.backend().median_split(points, offsets, depth, static_cast<size_t>(unit), order.span,
                                    leaf_offset.span, work);
    }
    return py::make_tuple(order.object, leaf_offset.object);
}

py::object findings_of(const Rows& gaussians) {
    const GaussianRows<const float> rows = gaussians.read<float>();
    check_is_on_host(gaussians.device(), "gaussians",
                     "expected arrays on the host, got arrays on a device; copy them to the host");
    const NewArray<uint16_t> findings({}, {static_cast<py::ssize_t>(rows.size)});
    {
        const Unlocked unlocked;
        examine(rows, findings.span);
    }
    return findings.object;
}

py::object order_along_curve(const py::array& means) {
    const auto values = span_of<const float>(means, "means", {-1, 3});
    const Span<const Point> points{reinterpret_cast<const Point*>(values.data), values.size / 3};
    check_finite(values);
    const NewArray<int64_t> order({}, {static_cast<py::ssize_t>(points.size)});
    {
        const Unlocked unlocked;
        morton_order(points, order.span);
    }
    return order.object;
}

py::object bound_spheres(const py::object& spheres, const py::array& offset) {
    const Device device = device_of(spheres, "spheres");
    const Span<const float> rows = span_on<const float>(device, spheres, "spheres", {-1, 4});
    const Span<const Ball> in{reinterpret_cast<const Ball*>(rows.data), rows.size / 4};
    const Span<const int64_t> offsets = offsets_of(offset, in.size);
    const Work work(device);
    const NewArray<float> ball(device, {static_cast<py::ssize_t>(offsets.size - 1), 4});
    const Span<Ball> out{reinterpret_cast<Ball*>(ball.span.data), offsets.size - 1};
    {
        const Unlocked unlocked;
        work.backend().bound_spheres(in, offsets, kNestingMargin, out, work);
    }
    return ball.object;
}

py::object bound_by_boxes(const Rows& gaussians, const py::array& offset) {
    const GaussianRows<const float> rows = gaussians.read<float>();
    const BoxInput in{rows.means, rows.quats, rows.scales, offsets_of(offset, rows.size)};
    const Work work(gaussians.device());
    const NewArray<float> box(gaussians.device(),
                              {static_cast<py::ssize_t>(in.offset.size - 1), 2, 3});
    const Span<Box> out{reinterpret_cast<Box*>(box.span.data), in.offset.size - 1};
    {
        const Unlocked unlocked;
        work.backend().bound_by_boxes(in, out, work);
    }
    return box.object;
}

void check_bundle_tables(const py::array& offset, const py::array& level,
                         const py::array& own_group, const py::array& parent_group,
                         const py::array& box, const py::array& filter_px2,
                         const py::array& antialiased, const py::array& ball,
                         const py::array& weight, const py::array& parent,
                         const py::array& group_level, const py::array& error,
                         int64_t num_gaussians) {
    const py::ssize_t c = level.size(), g = parent.size();
    const Span<const float> boxes = span_of<const float>(box, "clusters.box", {c, 2, 3}),
                            balls = span_of<const float>(ball, "groups.ball", {g, 4});
    const GivenTables tables{span_of<const int64_t>(offset, "clusters.offset", {c + 1}),
                             span_of<const int32_t>(level, "clusters.level", {c}),
                             span_of<const int32_t>(own_group, "clusters.own_group", {c}),
                             span_of<const int32_t>(parent_group, "clusters.parent_group", {c}),
                             {reinterpret_cast<const Box*>(boxes.data), static_cast<size_t>(c)},
                             span_of<const float>(filter_px2, "clusters.filter_px2", {c}),
                             span_of<const uint8_t>(antialiased, "clusters.antialiased", {c}),
                             {reinterpret_cast<const Ball*>(balls.data), static_cast<size_t>(g)},
                             span_of<const float>(weight, "groups.weight", {g}),
                             span_of<const int32_t>(parent, "groups.parent", {g}),
                             span_of<const int32_t>(group_level, "groups.level", {g}),
                             span_of<const float>(error, "groups.error", {g, 2})};
    try {
        const Unlocked unlocked;
        check_tables(tables, num_gaussians);
    } catch (const TableFault& fault) {
        const std::map<std::string, py::array> arrays = {
            {"clusters.offset", offset},
            {"clusters.level", level},
            {"clusters.own_group", own_group},
            {"clusters.parent_group", parent_group},
            {"clusters.box", box},
            {"clusters.filter_px2", filter_px2},
            {"clusters.antialiased", antialiased},
            {"groups.ball", ball},
            {"groups.weight", weight},
            {"groups.parent", parent},
            {"groups.level", group_level},
            {"groups.error", error},
        };
        const auto found = arrays.find(fault.table);
        const py::int_ row(fault.row);
        const py::object got =
            found == arrays.end() ? py::object(row) : found->second[row].attr("tolist")();
        const py::str message =
            py::str("{}[{}]: expected {}, got {}").format(fault.table, row, fault.expected, got);
        throw py::value_error(message.cast<std::string>());
    }
}

}  // namespace

void bind_cluster(py::module_& m) {
    m.attr("nesting_margin") = kNestingMargin;
    m.attr("min_radius") = kMinRadius;
    m.attr("most_length") = kMostLength;
    m.def("examine", &findings_of, "gaussians"_a,
          "Returns why each gaussian cannot be drawn, as (N,) uint16 of bits; 0 if it can be "
          "drawn. Arrays must be on the host.");
    m.def("num_halvings", &halvings, "count"_a, "cluster_size"_a,
          "Returns how often `count` points must be halved until no part has more than "
          "cluster_size.");
    m.def("median_split", &median_split, "means"_a, "offset"_a, "depth"_a, "unit"_a = 1,
          "Sorts the points of each segment into the leaves of a perfect binary tree. The left "
          "part of a node has half of its points, rounded up to a multiple of unit. Returns order "
          "(N,) int64, and leaf_offset (L + 1,) int64 on the host.");
    m.def("morton_order", &order_along_curve, "means"_a,
          "Returns the order (N,) of points along a Morton curve, so that adjacent points are "
          "close in space. Arrays must be on the host.");
    m.def("bound_spheres", &bound_spheres, "spheres"_a, "offset"_a,
          "Returns a ball around each segment of spheres (N, 4): (S, 4). A margin ensures that "
          "balls nest.");
    m.def("check_tables", &check_bundle_tables, "offset"_a, "level"_a, "own_group"_a,
          "parent_group"_a, "box"_a, "filter_px2"_a, "antialiased"_a, "ball"_a, "weight"_a,
          "parent"_a, "group_level"_a, "error"_a, py::kw_only(), "num_gaussians"_a,
          "Raises ValueError unless the tables of a bundle are consistent and lead to exact cuts.");
    m.def("bound_by_boxes", &bound_by_boxes, "gaussians"_a, "offset"_a,
          "Returns boxes around what clusters draw: (C, 2, 3), lower and upper corners.");
}

}  // namespace v3dg
