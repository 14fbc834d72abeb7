#pragma once

// Arrays on a device, from whatever has __cuda_array_interface__ (torch tensors, CuPy arrays).

#include "bindings/args.h"

namespace v3dg {

// Borrows a device array after the checks of span_of. The caller keeps the array alive and its stream
// ordered.
template <class T>
Span<T> device_span_of(const py::handle& array, const char* name, std::initializer_list<py::ssize_t> shape) {
    using Value = std::remove_const_t<T>;
    PyObject* found = PyObject_GetAttrString(array.ptr(), "__cuda_array_interface__");
    if (found == nullptr) {
        // An interrupt may arrive here, too.
        if (!PyErr_ExceptionMatches(PyExc_AttributeError)) throw py::error_already_set();
        PyErr_Clear();
        throw py::type_error(std::string(name) + ": expected an array on a CUDA device, got " +
                             py::str(py::type::of(array)).cast<std::string>());
    }
    const py::dict face = py::reinterpret_steal<py::object>(found).cast<py::dict>();
    static const std::string wanted_dtype =
        py::dtype::of<Value>().attr("str").template cast<std::string>();  // slow to ask for
    const std::string dtype = face["typestr"].cast<std::string>();
    if (dtype != wanted_dtype)
        throw py::value_error(std::string(name) + ": expected dtype " + wanted_dtype + ", got " + dtype);
    const py::tuple got = face["shape"].cast<py::tuple>();
    bool same = got.size() == shape.size();
    size_t axis = 0, size = 1;
    for (const py::ssize_t length : shape) {
        const py::ssize_t here = axis < got.size() ? got[axis].cast<py::ssize_t>() : -1;
        same = same && (length < 0 || here == length);
        size *= static_cast<size_t>(here);
        ++axis;
    }
    if (!same)
        throw py::value_error(std::string(name) + ": expected shape " + shape_text(shape) + ", got " +
                              py::str(got).cast<std::string>());
    if (face.contains("strides") && !face["strides"].is_none())
        throw py::value_error(std::string(name) + ": expected a contiguous array, got a strided one");
    const uintptr_t pointer = face["data"].cast<py::tuple>()[0].cast<uintptr_t>();
    return {reinterpret_cast<T*>(pointer), size};
}

}  // namespace v3dg
