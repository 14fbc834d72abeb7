#include <algorithm>
#include <cmath>
#include <functional>

#include "bindings/operations.h"
#include "bindings/tables.h"

namespace v3dg {

namespace {

void check_groups(Span<const int32_t> groups, const char* name, size_t num_groups) {
    for (const int32_t g : groups)
        if (g < -1 || (g >= 0 && static_cast<size_t>(g) >= num_groups))
            throw py::value_error(std::string(name) + ": expected -1 or a group below " +
                                  std::to_string(num_groups) + ", got " + std::to_string(g));
}

template <class T>
py::array_t<T> array_of(const std::vector<T>& values) {
    return py::array_t<T>(static_cast<py::ssize_t>(values.size()), values.data());
}

using Tables = std::vector<std::reference_wrapper<const BoundTable>>;

// Arguments of one selection on the host; `tables` and `input` borrow from them.
struct Arguments {
    std::vector<ClusterTable> tables;
    SelectInput input;

    Arguments(const Tables& tables_of_bundles, const Instances& instances, const BoundCamera& camera,
              const SelectRule& rule) {
        for (const BoundTable& table : tables_of_bundles) tables.push_back(table.table());
        instances.check_bundles(tables.size());
        input = {{tables.data(), tables.size()}, instances.table(), camera.camera, rule};
    }
};

py::tuple group_metrics(const Tables& tables, const Instances& instances, const BoundCamera& camera,
                        const SelectRule& rule) {
    const Arguments arguments(tables, instances, camera, rule);
    const Span<const int32_t> bundle = arguments.input.instances.bundle;
    const NewArray<int64_t> offset({}, {static_cast<py::ssize_t>(bundle.size + 1)});
    offset.span[0] = 0;
    for (size_t i = 0; i < bundle.size; ++i)
        offset.span[i + 1] = offset.span[i] + static_cast<int64_t>(arguments.tables[bundle[i]].ball.size);
    const NewArray<float> metric({}, {static_cast<py::ssize_t>(offset.span[bundle.size])});
    {
        const py::gil_scoped_release unlocked;
        cpu::group_metrics(arguments.input, offset.span, metric.span);
    }
    return py::make_tuple(metric.object, offset.object);
}

}  // namespace

BoundTable::BoundTable(py::array ball, py::array weight, py::array level, py::array own_group,
                       py::array parent_group, py::array box, py::array filter_px2, py::array antialiased,
                       py::array offset)
    : arrays_{ball, weight, level, own_group, parent_group, box, filter_px2, antialiased, offset} {
    const Span<const float> balls = span_of<const float>(ball, "ball", {-1, 4});
    const size_t num_groups = balls.size / 4;
    const auto groups = static_cast<py::ssize_t>(num_groups);
    table_.ball = {reinterpret_cast<const Ball*>(balls.data), num_groups};
    table_.weight = span_of<const float>(weight, "weight", {groups});
    table_.level = span_of<const int32_t>(level, "level", {groups});
    table_.own_group = span_of<const int32_t>(own_group, "own_group", {-1});
    const auto clusters = static_cast<py::ssize_t>(table_.own_group.size);
    table_.parent_group = span_of<const int32_t>(parent_group, "parent_group", {clusters});
    const Span<const float> boxes = span_of<const float>(box, "box", {clusters, 2, 3});
    table_.box = {reinterpret_cast<const Box*>(boxes.data), table_.own_group.size};
    filter_px2_ = span_of<const float>(filter_px2, "filter_px2", {clusters});
    antialiased_ = span_of<const uint8_t>(antialiased, "antialiased", {clusters});
    table_.offset = span_of<const int64_t>(offset, "offset", {clusters + 1});
    check_groups(table_.own_group, "own_group", num_groups);
    check_groups(table_.parent_group, "parent_group", num_groups);
    offsets_of(offset, num_gaussians());
    find_top();
    find_bounds();
    float filter = 0.0f;
    for (const float value : filter_px2_) filter = std::max(filter, value);
    table_.pad_px = static_cast<float>(kReachSigmas) * std::sqrt(filter) + 1.0f;
}

void BoundTable::find_top() {
    std::vector<uint8_t> is_top(table_.ball.size, 0);
    for (size_t c = 0; c < table_.parent_group.size; ++c) {
        if (table_.parent_group[c] >= 0) continue;
        top_cluster_.push_back(static_cast<int32_t>(c));
        if (table_.own_group[c] >= 0) is_top[table_.own_group[c]] = 1;
    }
    for (size_t g = 0; g < is_top.size(); ++g)
        if (is_top[g]) top_group_.push_back(static_cast<int32_t>(g));
    table_.top_group = {top_group_.data(), top_group_.size()};
    table_.top_cluster = {top_cluster_.data(), top_cluster_.size()};
}

void BoundTable::find_bounds() {
    table_.bounds = no_box();
    for (const Box& box : table_.box) grow(table_.bounds, box);
}

BoundCut::BoundCut(const SelectOutput& out)
    : instance_ids(array_of(out.instance)),
      cluster_ids(array_of(out.cluster)),
      num_gaussians(out.num_gaussians),
      tolerance_px2(out.tolerance_px2),
      fits_budget(out.fits_budget) {}

void bind_select(py::module_& m) {
    py::class_<BoundTable>(m, "ClusterTable", "What selection and drawing read of a bundle's clusters.")
        .def(py::init<py::array, py::array, py::array, py::array, py::array, py::array, py::array, py::array,
                      py::array>(),
             py::kw_only(), "ball"_a, "weight"_a, "level"_a, "own_group"_a, "parent_group"_a, "box"_a,
             "filter_px2"_a, "antialiased"_a, "offset"_a);
    py::class_<BoundCut>(m, "Cut", "The clusters that one view needs, and what their selection came to.")
        .def_readonly("instance_ids", &BoundCut::instance_ids)
        .def_readonly("cluster_ids", &BoundCut::cluster_ids)
        .def_readonly("num_gaussians", &BoundCut::num_gaussians)
        .def_readonly("tolerance_px2", &BoundCut::tolerance_px2)
        .def_readonly("fits_budget", &BoundCut::fits_budget);
    m.def("group_metrics", &group_metrics, "tables"_a, "instances"_a, "camera"_a, "rule"_a,
          "Metric of every group of every instance, px2, and where each instance's metrics begin.");
}

}  // namespace v3dg
