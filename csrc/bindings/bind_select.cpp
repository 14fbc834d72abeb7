#include <stdexcept>

#include "bindings/select_args.h"

namespace v3dg {

namespace {

// Arguments of one selection; `tables` and `input` borrow from them.
struct Arguments {
    std::vector<ClusterTable> tables;
    SelectInput input;
};

Arguments arguments_of(const py::list& tables, const py::array& instance_bundle, const py::array& positions,
                       const py::array& rotations, const py::array& scales, const py::array& viewmat,
                       const py::array& eye, const py::array& K, double width, double height, double near,
                       double tolerance, const std::string& footprint) {
    Arguments arguments;
    for (const py::handle table : tables) arguments.tables.push_back(table.cast<const BoundTable&>().table());
    SelectInput& input = arguments.input;
    input.instances = instance_table(instance_bundle, positions, rotations, scales, arguments.tables.size());
    input.camera = select_camera(viewmat, eye, K, width, height, near);
    input.rule = select_rule(input.camera, tolerance, footprint, false);
    return arguments;
}

int num_cuda_devices() {
    if constexpr (V3DG_WITH_CUDA) return cuda::num_devices();
    return 0;
}

template <class T>
py::array_t<T> array_of(const std::vector<T>& values) {
    return py::array_t<T>(static_cast<py::ssize_t>(values.size()), values.data());
}

py::tuple select(const py::list& tables, const py::array& instance_bundle, const py::array& positions,
                 const py::array& rotations, const py::array& scales, const py::array& viewmat,
                 const py::array& eye, const py::array& K, double width, double height, double near,
                 double tolerance, const std::string& footprint, bool cull, const std::string& device) {
    Arguments arguments = arguments_of(tables, instance_bundle, positions, rotations, scales, viewmat, eye, K,
                                       width, height, near, tolerance, footprint);
    SelectInput& input = arguments.input;
    input.bundles = {arguments.tables.data(), arguments.tables.size()};
    input.rule.culls = cull;
    SelectOutput output;
    if (device == "cpu") {
        const py::gil_scoped_release unlocked;
        cpu::select(input, output);
    } else if (device == "cuda") {
        if constexpr (V3DG_WITH_CUDA) {
            if (num_cuda_devices() == 0)
                throw std::runtime_error(
                    "device: expected a CUDA device and its driver, found none; use cpu");
            const py::gil_scoped_release unlocked;
            cuda::select(input, output);
        } else {
            throw std::runtime_error(
                "device: v3dg was built without CUDA; use cpu, or install it again where nvcc is found");
        }
    } else {
        throw py::value_error("device: expected cpu or cuda, got " + device);
    }
    return py::make_tuple(array_of(output.instance), array_of(output.cluster), output.num_gaussians);
}

py::tuple group_metrics(const py::list& tables, const py::array& instance_bundle, const py::array& positions,
                        const py::array& rotations, const py::array& scales, const py::array& viewmat,
                        const py::array& eye, const py::array& K, double width, double height, double near,
                        const std::string& footprint) {
    Arguments arguments = arguments_of(tables, instance_bundle, positions, rotations, scales, viewmat, eye, K,
                                       width, height, near, 0.0, footprint);
    SelectInput& input = arguments.input;
    input.bundles = {arguments.tables.data(), arguments.tables.size()};
    const Span<const int32_t> bundle = input.instances.bundle;
    py::array_t<int64_t> offset(static_cast<py::ssize_t>(bundle.size + 1));
    const Span<int64_t> offsets{offset.mutable_data(), bundle.size + 1};
    offsets[0] = 0;
    for (size_t i = 0; i < bundle.size; ++i)
        offsets[i + 1] = offsets[i] + static_cast<int64_t>(arguments.tables[bundle[i]].ball.size);
    py::array_t<float> metric(static_cast<py::ssize_t>(offsets[bundle.size]));
    const Span<float> metrics{metric.mutable_data(), static_cast<size_t>(metric.size())};
    {
        const py::gil_scoped_release unlocked;
        cpu::group_metrics(input, offsets, metrics);
    }
    return py::make_tuple(metric, offset);
}

}  // namespace

void bind_select(py::module_& m) {
    using namespace py::literals;
    py::class_<BoundTable>(m, "ClusterTable", "What selection reads of a bundle; borrows the arrays.")
        .def(py::init<py::array, py::array, py::array, py::array, py::array, py::array, py::array>(),
             "ball"_a, "weight"_a, "own_group"_a, "parent_group"_a, "box"_a, "filter_px2"_a, "offset"_a);
    m.def("num_cuda_devices", &num_cuda_devices, "CUDA devices to run on; 0 without CUDA or a driver.");
    m.def("select", &select, "tables"_a, "instance_bundle"_a, "positions"_a, "rotations"_a, "scales"_a,
          "viewmat"_a, "eye"_a, "K"_a, "width"_a, "height"_a, "near"_a, "tolerance"_a, "footprint"_a,
          "cull"_a, "device"_a,
          "Clusters that one view needs: (instance (S,) int32, cluster (S,) int32, number of gaussians).");
    m.def("group_metrics", &group_metrics, "tables"_a, "instance_bundle"_a, "positions"_a, "rotations"_a,
          "scales"_a, "viewmat"_a, "eye"_a, "K"_a, "width"_a, "height"_a, "near"_a, "footprint"_a,
          "Metric of every group of every instance, px2, and where each instance's metrics begin.");
}

}  // namespace v3dg
