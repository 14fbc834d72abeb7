// Bindings of resident objects (models, palettes, scenes) and of false colours.

#include "bindings/operations.h"
#include "bindings/resident.h"
#include "draw/false_color.h"

namespace v3dg {

namespace {

// Returns the colours color(0) to color(count - 1) as an array of `shape` + (3,).
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
        "Returns the false colours of levels, the finest first: (count, 3).");
    m.def(
        "cluster_colors",
        [](size_t count) { return colors_of({py::ssize_t(count)}, count, cluster_color); },
        "count"_a, "Returns the false colours of clusters: (count, 3). Adjacent clusters differ.");
    const auto add = [&](const char* name, auto color, const char* doc) {
        m.def(
            name,
            [color](const Values& values) {
                return colors_of({values.shape(), values.shape() + values.ndim()}, values.size(),
                                 [&](size_t i) { return color(values.data()[i]); });
            },
            "values"_a, doc);
    };
    add("ramp", ramp_color,
        "Returns the colours of values from 0 to 1 on a scale from dark to bright: (..., 3).");
    add(
        "missing_colors", [](float share) { return missing_color(share, 1.0f); },
        "Returns the colours of clusters for ratios of metric to tolerance: (..., 3).");
}

}  // namespace

void bind_scene(py::module_& m) {
    bind_colors(m);
    py::class_<BoundModel>(m, "Model",
                           "The gaussians of a bundle or an asset, in the layout "
                           "that frames on one device read.")
        .def(py::init<const Rows&>(), "gaussians"_a)
        .def(py::init<py::object, int>(), "codes"_a, "device"_a)
        .def("decode", &BoundModel::decode, "cluster_ids"_a,
             "Returns the gaussians of some clusters of a coded model: means, quats, scales, "
             "opacities, sh.")
        .def("__len__", &BoundModel::size)
        .def_property_readonly("bytes", &BoundModel::bytes);
    py::class_<BoundPalette>(
        m, "Palette",
        "The colours of a bundle's clusters, which can replace the colours of the "
        "gaussians.")
        .def(py::init<py::object, py::array, int>(), "table"_a, "sh"_a, "device"_a);
    py::class_<BudgetSteps>(m, "BudgetSteps",
                            "The state that a budget keeps between consecutive pictures.")
        .def(py::init<>());
    py::class_<BoundScene>(m, "ResidentScene",
                           "The part of a scene that selection reads, on one device.")
        .def(py::init<int>(), "device"_a)
        .def("set_bundles", &BoundScene::set_bundles, "tables"_a)
        .def("set_instances", &BoundScene::set_instances, "bundle"_a, "importance"_a, "positions"_a,
             "quaternions"_a, "scales"_a, "factors"_a = py::none(), "environments"_a = py::none(),
             "labels"_a = py::none())
        .def("set_poses", &BoundScene::set_poses, "positions"_a, "quaternions"_a, "scales"_a)
        .def("select", &BoundScene::select, "camera"_a, "rule"_a, "steps"_a = nullptr)
        .def("page_needs", &BoundScene::page_needs, "camera"_a, "rule"_a,
             "Returns the priority of each page, (G + 1,) for each bundle. It is above 1 if the "
             "cut needs the page.");
}

}  // namespace v3dg
