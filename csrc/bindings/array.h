#pragma once

// Arrays that users hold: NumPy's on the host, and what a backend takes on a device, such as
// torch's tensors. They are borrowed after checks of kind, dtype, shape and layout, never copied.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <cstdint>
#include <initializer_list>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "base/dispatch.h"
#include "base/span.h"
#include "bindings/python_lock.h"

namespace v3dg {

namespace py = pybind11;
using namespace py::literals;

// A shape as it is wanted; -1 stands for any length.
using Shape = std::initializer_list<py::ssize_t>;
std::string shape_text(Shape shape);
std::string shape_text(const py::handle& array);

// TypeError: the argument is another kind of object than is expected.
[[noreturn]] void refuse_kind(const char* name, const std::string& expected, const py::handle& got);

// What a Python object holds that is kept as such; TypeError where that is something else.
template <class T>
T& held(const py::handle& object, const char* name) {
    if (!py::isinstance<T>(object))
        refuse_kind(name, py::type::of<T>().attr("__name__").template cast<std::string>(), object);
    return object.cast<T&>();
}

// The shape of an array on any device; TypeError where there is none.
std::vector<py::ssize_t> shape_of(const py::handle& array, const char* name);

// What elements are, as NumPy and as __cuda_array_interface__ have it.
struct Element {
    py::dtype (*dtype)();
    const char* typestr;
};
template <class T>
constexpr Element element_of() {
    if constexpr (std::is_same_v<T, float>) return {&py::dtype::of<T>, "<f4"};
    if constexpr (std::is_same_v<T, double>) return {&py::dtype::of<T>, "<f8"};
    if constexpr (std::is_same_v<T, int32_t>) return {&py::dtype::of<T>, "<i4"};
    if constexpr (std::is_same_v<T, int64_t>) return {&py::dtype::of<T>, "<i8"};
    if constexpr (std::is_same_v<T, uint16_t>) return {&py::dtype::of<T>, "<u2"};
    if constexpr (std::is_same_v<T, uint8_t>) return {&py::dtype::of<T>, "|u1"};
}

// Memory that is borrowed from an array, in elements.
struct Borrowed {
    void* data;
    size_t size;
};

constexpr Device kHost{};

// Where an array is. TypeError where it is neither NumPy's nor a device's, RuntimeError where it
// needs a backend that this v3dg was built without.
Device device_of(const py::handle& array, const char* name);

// The description of an array on a CUDA device, __cuda_array_interface__; None where it has none.
py::object cuda_interface_of(const py::handle& array);

bool fits_shape(const std::vector<py::ssize_t>& got, Shape wanted);

// ValueError: name, colon, problem.
[[noreturn]] void refuse_value(const char* name, const std::string& problem);

// Borrows an array of NumPy's after checks of its dtype and shape.
Borrowed borrow_on_host(const py::handle& array, const char* name, const Element& element,
                        Shape shape, bool is_written);

// Borrows an array after checks that it is on this device, and has this dtype and shape. The caller
// keeps it alive and its stream ordered.
Borrowed borrow(Device device, const py::handle& array, const char* name, const Element& element,
                Shape shape, bool is_written);

// Borrows an array on the host; T is const where it is only read.
template <class T>
Span<T> span_of(const py::handle& array, const char* name, Shape shape) {
    const Borrowed borrowed = borrow_on_host(array, name, element_of<std::remove_const_t<T>>(),
                                             shape, !std::is_const_v<T>);
    return {static_cast<T*>(borrowed.data), borrowed.size};
}

// Borrows an array that has to be where others are.
template <class T>
Span<T> span_on(Device device, const py::handle& array, const char* name, Shape shape) {
    const Borrowed borrowed = borrow(device, array, name, element_of<std::remove_const_t<T>>(),
                                     shape, !std::is_const_v<T>);
    return {static_cast<T*>(borrowed.data), borrowed.size};
}

// A new array, not initialised, and its memory. Too little memory is a MemoryError.
struct MadeArray {
    py::object object;
    void* data;
};
MadeArray make_array(Device device, const Element& element, const std::vector<py::ssize_t>& shape);

// The same, borrowed to be filled in.
template <class T>
struct NewArray {
    py::object object;
    Span<T> span;

    NewArray(Device device, const std::vector<py::ssize_t>& shape) {
        MadeArray made = make_array(device, element_of<T>(), shape);
        object = std::move(made.object);
        size_t size = 1;
        for (const py::ssize_t length : shape) size *= static_cast<size_t>(length);
        span = {static_cast<T*>(made.data), size};
    }
};

class Backend;

// Work on a device, on the stream that torch uses there; that device is the current one meanwhile.
// Made and destroyed with Python's lock, which the work itself is done without. RuntimeError where
// there is no such device.
class Work {
  public:
    explicit Work(Device device);
    ~Work();
    Work(const Work&) = delete;
    Work& operator=(const Work&) = delete;

    Device device() const { return device_; }
    const Backend& backend() const { return backend_; }
    // What the backend calls a stream; null on the host.
    void* stream() const { return stream_; }

  private:
    const Device device_;
    const Backend& backend_;
    int device_before_ = 0;
    void* stream_ = nullptr;
};

}  // namespace v3dg
