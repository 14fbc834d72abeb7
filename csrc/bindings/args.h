#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <initializer_list>
#include <string>
#include <type_traits>

#include "base/span.h"

namespace v3dg {

namespace py = pybind11;

// An array of exactly this dtype, contiguous; pybind11 refuses others instead of copying (py::arg.noconvert).
template <class T>
using ArrayOf = py::array_t<T, py::array::c_style>;

// A shape as it is wanted; -1 stands for any length.
inline std::string shape_text(std::initializer_list<py::ssize_t> shape) {
    std::string text;
    for (const py::ssize_t length : shape)
        text += (text.empty() ? "" : ", ") + (length < 0 ? std::string("N") : std::to_string(length));
    return "(" + text + (shape.size() == 1 ? ",)" : ")");
}

inline std::string shape_text(const py::array& array) {
    std::string text = "(";
    for (py::ssize_t i = 0; i < array.ndim(); ++i)
        text += std::to_string(array.shape(i)) + (array.ndim() == 1 || i + 1 < array.ndim() ? "," : "") +
                (i + 1 < array.ndim() ? " " : "");
    return text + ")";
}

// Borrows `array` after checking that it has `dtype` T, is contiguous, and has `shape` (-1: any length).
template <class T>
Span<T> span_of(const py::array& array, const char* name, std::initializer_list<py::ssize_t> shape) {
    using Value = std::remove_const_t<T>;
    if (!py::isinstance<py::array_t<Value>>(array))
        throw py::value_error(std::string(name) + ": expected dtype " +
                              py::str(py::dtype::of<Value>()).template cast<std::string>() + ", got " +
                              py::str(array.dtype()).cast<std::string>());
    bool same = array.ndim() == static_cast<py::ssize_t>(shape.size());
    size_t axis = 0;
    for (const py::ssize_t length : shape) {
        if (same && length >= 0 && array.shape(axis) != length) same = false;
        ++axis;
    }
    if (!same)
        throw py::value_error(std::string(name) + ": expected shape " + shape_text(shape) + ", got " +
                              shape_text(array));
    if (!(array.flags() & py::array::c_style))
        throw py::value_error(
            std::string(name) +
            ": expected a C-contiguous array, got a strided one; call numpy.ascontiguousarray");
    T* data = std::is_const<T>::value ? static_cast<T*>(const_cast<void*>(array.data()))
                                      : static_cast<T*>(const_cast<py::array&>(array).mutable_data());
    return {data, static_cast<size_t>(array.size())};
}

void bind_box(py::module_& m);
void bind_cluster(py::module_& m);
void bind_gather(py::module_& m);
void bind_select(py::module_& m);
void bind_simplify(py::module_& m);
void bind_ply(py::module_& m);
void bind_render(py::module_& m);
void bind_rasterize_cuda(py::module_& m);
void bind_fit_level(py::module_& m);
void bind_loss(py::module_& m);
void bind_frame(py::module_& m);  // nothing without CUDA

}  // namespace v3dg
