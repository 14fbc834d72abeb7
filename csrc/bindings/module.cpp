// The compiled module: what it needs of the process, and its parts in order.

#include <dlfcn.h>
#include <omp.h>
#include <pthread.h>

#include <cstring>
#include <new>

#include "base/isa.h"
#include "bindings/backend.h"
#include "bindings/operations.h"
#include "bindings/python_lock.h"
#include "math/gaussian.h"
#include "residency/cluster_table.h"

// A child of fork() has none of the threads that GNU's OpenMP keeps for the next loop, but would
// wait for them without end. So the thread that forks lets its own go first; they come back, on
// either side, with the next loop. LLVM's OpenMP, which may stand in, minds forks itself and then
// holds locks that this would wait for.
static void let_threads_go() { omp_pause_resource_all(omp_pause_hard); }
static bool must_let_threads_go() {
    Dl_info found;
    return dladdr(reinterpret_cast<void*>(&omp_pause_resource_all), &found) != 0 &&
           std::strstr(found.dli_fname, "libgomp") != nullptr;
}

static int num_cuda_devices() {
    const v3dg::Backend* const backend = v3dg::device_backend();
    return backend == nullptr ? 0 : backend->num_devices();
}

// An object that only `__new__` has made holds nothing. When a function is given one, pybind11 asks
// its class for memory of that size, whose content nobody has made.
static void* refuse_unmade(size_t) {
    throw v3dg::py::type_error(
        "self: expected an object that its class has made, got one of __new__ alone; call the "
        "class instead");
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
    if (must_let_threads_go() && pthread_atfork(&let_threads_go, nullptr, nullptr) != 0)
        throw std::bad_alloc();
    v3dg::watch_end_of_python();
    m.doc() = "Compiled operations of v3dg; the public interface is the package v3dg.";
    m.attr("min_alpha") = v3dg::kMinAlpha;
    m.attr("fade_filter_px2") = v3dg::kFadeFilterPx2;
    m.attr("sh_base0") = v3dg::kShBase0;
    m.attr("has_cuda") = v3dg::device_backend() != nullptr;
    m.def(
        "isa", [] { return v3dg::isa_name(v3dg::active_isa()); },
        "Instruction set that the CPU half runs on.");
    m.def("num_cuda_devices", &num_cuda_devices,
          "CUDA devices to run on; 0 without CUDA or a driver.");
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
    v3dg::bind_frame(m);
    v3dg::bind_fit_level(m);
    v3dg::bind_first_selected(m);
    refuse_unmade_objects(m);
}
