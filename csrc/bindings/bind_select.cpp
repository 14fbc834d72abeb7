#include "bindings/select_args.h"

namespace v3dg {

namespace {

// Arguments of one selection; `tables` and `input` borrow from them.
struct Arguments {
    std::vector<ClusterTable> tables;
    SelectInput input;

    Arguments(const py::list& tables_of_bundles, const py::tuple& instances, const py::tuple& camera,
              const py::tuple& rule) {
        for (const py::handle table : tables_of_bundles)
            tables.push_back(table.cast<const BoundTable&>().table());
        input.bundles = {tables.data(), tables.size()};
        input.instances = instance_table(instances, tables.size());
        input.camera = select_camera(camera);
        input.rule = select_rule(rule);
    }
};

int num_cuda_devices() {
    if constexpr (V3DG_WITH_CUDA) return cuda::num_devices();
    return 0;
}

py::tuple select(const py::list& tables, const py::tuple& instances, const py::tuple& camera,
                 const py::tuple& rule) {
    const Arguments arguments(tables, instances, camera, rule);
    SelectOutput output;
    {
        const py::gil_scoped_release unlocked;
        cpu::select(arguments.input, output);
    }
    return tuple_of(output);
}

py::tuple group_metrics(const py::list& tables, const py::tuple& instances, const py::tuple& camera,
                        const py::tuple& rule) {
    const Arguments arguments(tables, instances, camera, rule);
    const Span<const int32_t> bundle = arguments.input.instances.bundle;
    py::array_t<int64_t> offset(static_cast<py::ssize_t>(bundle.size + 1));
    const Span<int64_t> offsets{offset.mutable_data(), bundle.size + 1};
    offsets[0] = 0;
    for (size_t i = 0; i < bundle.size; ++i)
        offsets[i + 1] = offsets[i] + static_cast<int64_t>(arguments.tables[bundle[i]].ball.size);
    py::array_t<float> metric(static_cast<py::ssize_t>(offsets[bundle.size]));
    const Span<float> metrics{metric.mutable_data(), static_cast<size_t>(metric.size())};
    {
        const py::gil_scoped_release unlocked;
        cpu::group_metrics(arguments.input, offsets, metrics);
    }
    return py::make_tuple(metric, offset);
}

}  // namespace

void bind_select(py::module_& m) {
    using namespace py::literals;
    py::class_<BoundTable>(m, "ClusterTable", "What selection reads of a bundle; borrows the arrays.")
        .def(py::init<py::array, py::array, py::array, py::array, py::array, py::array, py::array,
                      py::array>(),
             "ball"_a, "weight"_a, "level"_a, "own_group"_a, "parent_group"_a, "box"_a, "filter_px2"_a,
             "offset"_a);
    m.def("num_cuda_devices", &num_cuda_devices, "CUDA devices to run on; 0 without CUDA or a driver.");
    m.def(
        "eye_of",
        [](const py::array& viewmat) {
            py::array_t<double> eye(3);
            eye_of(span_of<const double>(viewmat, "viewmat", {4, 4}).data, eye.mutable_data());
            return eye;
        },
        "viewmat"_a, "Where a camera (4, 4) is in the world: (3,).");
    m.def("select", &select, "tables"_a, "instances"_a, "camera"_a, "rule"_a,
          "Clusters that one view needs: (instance (S,) int32, cluster (S,) int32, number of gaussians, "
          "tolerance, whether the budget was met).");
    m.def("group_metrics", &group_metrics, "tables"_a, "instances"_a, "camera"_a, "rule"_a,
          "Metric of every group of every instance, px2, and where each instance's metrics begin.");
}

}  // namespace v3dg
