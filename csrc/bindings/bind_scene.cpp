// What is resident, and false colours.

#include "bindings/operations.h"
#include "bindings/resident.h"
#include "draw/false_color.h"

namespace v3dg {

namespace {

// (..., 3) colours of values.
template <class Color>
py::array_t<float> colors_of(std::vector<py::ssize_t> shape, size_t count, const Color& color) {
    shape.push_back(3);
    py::array_t<float> colors(shape);
    for (size_t i = 0; i < count; ++i) {
        const Rgb rgb = color(i);
        std::copy(rgb.begin(), rgb.end(), colors.mutable_data() + 3 * i);
    }
    return colors;
}

using Values = py::array_t<float, py::array::c_style | py::array::forcecast>;

void bind_colors(py::module_& m) {
    m.def(
        "level_colors",
        [](size_t count) { return colors_of({py::ssize_t(count)}, count, level_color); }, "count"_a,
        "Colours of levels, from fine to coarse: (count, 3).");
    m.def(
        "cluster_colors",
        [](size_t count) { return colors_of({py::ssize_t(count)}, count, cluster_color); },
        "count"_a, "Colours of clusters, of which neighbours differ: (count, 3).");
    const auto add = [&](const char* name, auto color, const char* doc) {
        m.def(
            name,
            [color](const Values& values) {
                return colors_of({values.shape(), values.shape() + values.ndim()}, values.size(),
                                 [&](size_t i) { return color(values.data()[i]); });
            },
            "values"_a, doc);
    };
    add("ramp", ramp_color, "Colours of values of 0 to 1, from dark to bright: (..., 3).");
    add(
        "missing_colors", [](float share) { return missing_color(share, 1.0f); },
        "Colours of clusters whose metric is this share of the tolerance that is wanted: (..., "
        "3).");
}

}  // namespace

void bind_scene(py::module_& m) {
    bind_colors(m);
    py::class_<BoundModel>(m, "Model", "Gaussians as frames of their device read them.")
        .def(py::init<const Rows&>(), "gaussians"_a)
        .def(py::init<py::object, int>(), "codes"_a, "device"_a)
        .def("decode", &BoundModel::decode, "cluster_ids"_a,
             "Gaussians of clusters, where they are codes: means, quats, scales, opacities, sh.")
        .def("__len__", &BoundModel::size)
        .def_property_readonly("bytes", &BoundModel::bytes);
    py::class_<BoundPalette>(m, "Palette",
                             "Colours of a bundle's clusters, in which gaussians can be drawn.")
        .def(py::init<py::object, py::array, int>(), "table"_a, "sh"_a, "device"_a);
    py::class_<BudgetSteps>(m, "BudgetSteps",
                            "What pictures with a budget know of the ones before.")
        .def(py::init<>());
    py::class_<BoundScene>(m, "ResidentScene", "What selection reads of a scene, on one device.")
        .def(py::init<int>(), "device"_a)
        .def("set_bundles", &BoundScene::set_bundles, "tables"_a)
        .def("set_instances", &BoundScene::set_instances, "bundle"_a, "importance"_a, "positions"_a,
             "quaternions"_a, "scales"_a, "factors"_a = py::none())
        .def("set_poses", &BoundScene::set_poses, "positions"_a, "quaternions"_a, "scales"_a)
        .def("select", &BoundScene::select, "camera"_a, "rule"_a, "steps"_a = nullptr)
        .def("page_needs", &BoundScene::page_needs, "camera"_a, "rule"_a,
             "For each bundle how urgently its pages are needed: (G+1,), above 1 where the cut "
             "misses them.");
}

}  // namespace v3dg
