#pragma once

#include <pybind11/pybind11.h>

// The functions that define the bindings. There is one per source file, in the order in
// which module.cpp calls them.

namespace v3dg {

void bind_types(pybind11::module_& m);
void bind_ply(pybind11::module_& m);
void bind_cluster(pybind11::module_& m);
void bind_simplify(pybind11::module_& m);
void bind_gather(pybind11::module_& m);
void bind_quantize(pybind11::module_& m);
void bind_pages(pybind11::module_& m);
void bind_select(pybind11::module_& m);
void bind_rasterize(pybind11::module_& m);
void bind_scene(pybind11::module_& m);
void bind_pool(pybind11::module_& m);
void bind_sensor(pybind11::module_& m);
void bind_batch(pybind11::module_& m);
void bind_views(pybind11::module_& m);
void bind_frame(pybind11::module_& m);
void bind_rays(pybind11::module_& m);
void bind_fit_level(pybind11::module_& m);
void bind_first_selected(pybind11::module_& m);

}  // namespace v3dg
