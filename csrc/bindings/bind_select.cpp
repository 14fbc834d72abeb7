// Bindings of bundle tables, and of selection on the host without a resident scene.

#include <functional>

#include "bindings/backend.h"
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

// The input of a selection on the host. It borrows from the arguments.
struct Arguments {
    std::vector<ClusterTable> tables;
    SelectInput input;

    Arguments(const Tables& tables_of_bundles, const Instances& instances,
              const BoundCamera& camera, const SelectRule& rule) {
        for (const BoundTable& table : tables_of_bundles) tables.push_back(table.table());
        instances.check_bundles(tables.size());
        input = {{tables.data(), tables.size()}, instances.table(), camera.camera, rule, {}};
    }
};

// Returns where the values of each instance begin, then the total number. An instance
// of bundle b has counts[b] values.
NewArray<int64_t> offset_of_instances(Span<const int32_t> bundle,
                                      const std::vector<size_t>& counts) {
    NewArray<int64_t> offset({}, {static_cast<py::ssize_t>(bundle.size + 1)});
    offset.span[0] = 0;
    for (size_t i = 0; i < bundle.size; ++i)
        offset.span[i + 1] = offset.span[i] + static_cast<int64_t>(counts[bundle[i]]);
    return offset;
}

py::tuple group_metrics(const Tables& tables, const Instances& instances, const BoundCamera& camera,
                        const SelectRule& rule) {
    const Arguments arguments(tables, instances, camera, rule);
    std::vector<size_t> counts;
    for (const ClusterTable& table : arguments.tables) counts.push_back(table.ball.size);
    const Span<const int32_t> bundle = arguments.input.instances.bundle;
    const NewArray<int64_t> offset = offset_of_instances(bundle, counts);
    const NewArray<float> metric({}, {static_cast<py::ssize_t>(offset.span[bundle.size])});
    {
        const Unlocked unlocked;
        cpu::group_metrics(arguments.input, offset.span, metric.span);
    }
    return py::make_tuple(metric.object, offset.object);
}

py::tuple bounds_may_draw(const Tables& tables, const Instances& instances,
                          const BoundCamera& camera, const SelectRule& rule, bool and_coarser) {
    const Arguments arguments(tables, instances, camera, rule);
    std::vector<size_t> counts;
    for (const ClusterTable& table : arguments.tables)
        counts.push_back((table.num_clusters() + kClustersOfBounds - 1) / kClustersOfBounds);
    const Span<const int32_t> bundle = arguments.input.instances.bundle;
    const NewArray<int64_t> offset = offset_of_instances(bundle, counts);
    const NewArray<uint8_t> may_draw({}, {static_cast<py::ssize_t>(offset.span[bundle.size])});
    cpu::bounds_may_draw(arguments.input,
                         and_coarser ? Tolerances::from_this_on : Tolerances::this_one, offset.span,
                         may_draw.span);
    return py::make_tuple(may_draw.object, offset.object);
}

}  // namespace

BoundTable::BoundTable(py::array ball, py::array weight, py::array level, py::array own_group,
                       py::array parent_group, py::array box, py::array filter_px2,
                       py::array antialiased, py::array offset, py::object page_shift,
                       py::object page_begins)
    : arrays_{ball, weight, level, own_group, parent_group, box, filter_px2, antialiased, offset} {
    const Span<const float> balls = span_of<const float>(ball, "ball", {-1, 4});
    const size_t num_groups = balls.size / 4;
    const auto groups = static_cast<py::ssize_t>(num_groups);
    ClusterTable given{};
    given.ball = {reinterpret_cast<const Ball*>(balls.data), num_groups};
    given.weight = span_of<const float>(weight, "weight", {groups});
    given.level = span_of<const int32_t>(level, "level", {groups});
    given.own_group = span_of<const int32_t>(own_group, "own_group", {-1});
    const auto clusters = static_cast<py::ssize_t>(given.num_clusters());
    given.parent_group = span_of<const int32_t>(parent_group, "parent_group", {clusters});
    const Span<const float> boxes = span_of<const float>(box, "box", {clusters, 2, 3});
    given.box = {reinterpret_cast<const Box*>(boxes.data), given.num_clusters()};
    const ClusterAppearance appearance{
        span_of<const float>(filter_px2, "filter_px2", {clusters}),
        span_of<const uint8_t>(antialiased, "antialiased", {clusters})};
    given.offset = span_of<const int64_t>(offset, "offset", {clusters + 1});
    check_groups(given.own_group, "own_group", num_groups);
    check_groups(given.parent_group, "parent_group", num_groups);
    offsets_of(offset, static_cast<size_t>(given.offset[clusters]));
    if (!page_shift.is_none()) {
        given.pages.shift = span_of<const int64_t>(page_shift, "page_shift", {groups + 1});
        arrays_.push_back(py::reinterpret_borrow<py::array>(page_shift));
    }
    if (!page_begins.is_none()) {
        given.pages.begins = span_of<const int32_t>(page_begins, "page_begins", {groups + 1});
        arrays_.push_back(py::reinterpret_borrow<py::array>(page_begins));
    }
    host_ = std::make_unique<HostTable>(given, appearance);
}

std::shared_ptr<const backend::Tables> BoundTable::on(const Work& work) const {
    std::weak_ptr<const backend::Tables>& known = on_device_[work.device().number];
    std::shared_ptr<const backend::Tables> tables = known.lock();
    if (tables == nullptr) {
        tables = work.backend().make_tables(*this, work);
        known = tables;
    }
    return tables;
}

size_t BoundTable::bytes_on(int device) const {
    const auto found = on_device_.find(device);
    if (found == on_device_.end()) return 0;
    const std::shared_ptr<const backend::Tables> tables = found->second.lock();
    return tables == nullptr ? 0 : tables->bytes();
}

BoundCut::BoundCut(const SelectOutput& out)
    : instance_ids(array_of(out.instance)),
      cluster_ids(array_of(out.cluster)),
      weights(array_of(out.weight)),
      num_gaussians(out.num_gaussians),
      tolerance_px2(out.tolerance_px2),
      fits_budget(out.fits_budget) {}

void bind_select(py::module_& m) {
    py::class_<BoundTable>(m, "ClusterTable",
                           "The tables of a bundle that selection and drawing read.")
        .def(py::init<py::array, py::array, py::array, py::array, py::array, py::array, py::array,
                      py::array, py::array, py::object, py::object>(),
             py::kw_only(), "ball"_a, "weight"_a, "level"_a, "own_group"_a, "parent_group"_a,
             "box"_a, "filter_px2"_a, "antialiased"_a, "offset"_a, "page_shift"_a = py::none(),
             "page_begins"_a = py::none())
        .def("bytes_on", &BoundTable::bytes_on, "device"_a,
             "Returns the memory in bytes of the tables on a device.");
    py::class_<BoundCut>(m, "Cut",
                         "A selected cut: pairs (instance, cluster), and the results of the "
                         "budget.")
        .def_readonly("instance_ids", &BoundCut::instance_ids)
        .def_readonly("cluster_ids", &BoundCut::cluster_ids)
        .def_readonly("weights", &BoundCut::weights,
                      "The weight of each pair. Empty without a fade: all weights are 1.")
        .def_readonly("num_gaussians", &BoundCut::num_gaussians)
        .def_readonly("tolerance_px2", &BoundCut::tolerance_px2)
        .def_readonly("fits_budget", &BoundCut::fits_budget);
    m.def("group_metrics", &group_metrics, "tables"_a, "instances"_a, "camera"_a, "rule"_a,
          "Returns the metric, px², of every group of every instance, and the first index of "
          "each instance's metrics.");
    m.def("bounds_may_draw", &bounds_may_draw, "tables"_a, "instances"_a, "camera"_a, "rule"_a,
          "and_coarser"_a,
          "Returns one value per instance and run of eight clusters: 0 if bounds show that none "
          "of them is drawn, else 1. Also returns the first index of each instance's values.");
}

}  // namespace v3dg
