// Defines the compiled module: first its requirements on the process, then the bindings
// of each part.

#ifdef _OPENMP
#include <dlfcn.h>
#include <omp.h>

#include <cstring>
#endif

#include "base/isa.h"
#include "base/process.h"
#include "bindings/backend.h"
#include "bindings/operations.h"
#include "bindings/python_lock.h"
#include "math/gaussian.h"
#include "residency/cluster_table.h"

#ifdef _OPENMP
// Ends the idle threads of GNU's OpenMP (libgomp) before a fork(). The child would not
// have these threads, but would wait for them forever. The next parallel loop starts
// new threads, both in the parent and in the child. LLVM's OpenMP, which may replace
// libgomp, handles fork() itself. With it, this call would wait forever for locks that
// LLVM's own fork handler holds.
static void let_threads_go() { omp_pause_resource_all(omp_pause_hard); }
static bool must_let_threads_go() {
    Dl_info found;
    return dladdr(reinterpret_cast<void*>(&omp_pause_resource_all), &found) != 0 &&
           std::strstr(found.dli_fname, "libgomp") != nullptr;
}
#endif

static int num_cuda_devices() {
    const v3dg::Backend* const backend = v3dg::device_backend();
    return backend == nullptr ? 0 : backend->num_devices();
}

// Rejects objects that were only made by `__new__` and have no C++ value. When such an
// object is passed to a function, pybind11 asks its class to allocate the value, and
// would use it without initialising it.
static void* refuse_unmade(size_t) {
    throw v3dg::py::type_error(
        "self: this object was made by __new__ alone and has no value; call the class instead");
}
static void refuse_unmade_objects(const v3dg::py::module_& m) {
    for (const auto& [name, value] : v3dg::py::dict(m.attr("__dict__"))) {
        if (!v3dg::py::isinstance<v3dg::py::type>(value)) continue;
        v3dg::py::detail::type_info* const info =
            v3dg::py::detail::get_type_info(reinterpret_cast<PyTypeObject*>(value.ptr()));
        if (info != nullptr) info->operator_new = &refuse_unmade;
    }
}

PYBIND11_MODULE(_core, m) {
#ifdef _OPENMP
    if (must_let_threads_go()) v3dg::at_fork(&let_threads_go, nullptr);
#endif
    v3dg::watch_end_of_python();
    m.doc() = "The compiled operations of v3dg. The package v3dg is the public interface.";
    m.attr("min_alpha") = v3dg::kMinAlpha;
    m.attr("stops_before") = v3dg::kStopsBefore;
    m.attr("stops_by_cut") = v3dg::kStopsByCut;
    m.attr("fade_filter_px2") = v3dg::kFadeFilterPx2;
    m.attr("sh_base0") = v3dg::kShBase0;
    m.attr("has_cuda") = v3dg::device_backend() != nullptr;
#ifdef _OPENMP
    m.attr("has_openmp") = true;
#else
    m.attr("has_openmp") = false;
#endif
    m.def(
        "isa", [] { return v3dg::isa_name(v3dg::active_isa()); },
        "The instruction set that operations on the CPU use.");
    m.def("num_cuda_devices", &num_cuda_devices,
          "Returns the number of CUDA devices; 0 without CUDA or a driver.");
    v3dg::bind_types(m);
    v3dg::bind_ply(m);
    v3dg::bind_cluster(m);
    v3dg::bind_simplify(m);
    v3dg::bind_gather(m);
    v3dg::bind_quantize(m);
    v3dg::bind_pages(m);
    v3dg::bind_select(m);
    v3dg::bind_rasterize(m);
    v3dg::bind_scene(m);
    v3dg::bind_pool(m);
    v3dg::bind_sensor(m);
    v3dg::bind_batch(m);
    v3dg::bind_views(m);
    v3dg::bind_frame(m);
    v3dg::bind_rays(m);
    v3dg::bind_fit_level(m);
    v3dg::bind_first_selected(m);
    refuse_unmade_objects(m);
}
