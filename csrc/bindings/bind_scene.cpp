#include "bindings/operations.h"
#include "bindings/resident.h"

namespace v3dg {

void bind_scene(py::module_& m) {
    py::class_<BoundModel>(m, "Model", "Gaussians as frames of their device read them.")
        .def(py::init<const Rows&>(), "gaussians"_a)
        .def(py::init<py::object, int>(), "codes"_a, "device"_a)
        .def("decode", &BoundModel::decode, "cluster_ids"_a,
             "Gaussians of clusters, where they are codes: means, quats, scales, opacities, sh.")
        .def("__len__", &BoundModel::size)
        .def_property_readonly("bytes", &BoundModel::bytes);
    py::class_<BoundPalette>(m, "Palette", "Colours of a bundle's clusters, in which gaussians can be drawn.")
        .def(py::init<py::object, py::array, int>(), "table"_a, "sh"_a, "device"_a);
    py::class_<BudgetSteps>(m, "BudgetSteps", "What pictures with a budget know of the ones before.")
        .def(py::init<>());
    py::class_<BoundScene>(m, "ResidentScene", "What selection reads of a scene, on one device.")
        .def(py::init<int>(), "device"_a)
        .def("set_bundles", &BoundScene::set_bundles, "tables"_a)
        .def("set_instances", &BoundScene::set_instances, "bundle"_a, "importance"_a, "positions"_a,
             "quaternions"_a, "scales"_a)
        .def("set_poses", &BoundScene::set_poses, "positions"_a, "quaternions"_a, "scales"_a)
        .def("select", &BoundScene::select, "camera"_a, "rule"_a, "steps"_a = nullptr)
        .def("page_needs", &BoundScene::page_needs, "camera"_a, "rule"_a,
             "For each bundle how urgently its pages are needed: (G+1,), above 1 where the cut misses them.");
}

}  // namespace v3dg
