#pragma once

// Arrays that Python passes: NumPy arrays on the host and, on a device, arrays that its
// backend accepts, such as torch tensors. The bindings check kind, dtype, shape and
// layout, and then use the memory of the array without a copy ("borrow").

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <cstdint>
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

// An expected shape. -1 allows any length.
using Shape = std::vector<py::ssize_t>;
std::string shape_text(const Shape& shape);
std::string shape_text(const py::handle& array);

// Throws TypeError with the text "name: expected ..., got ...".
[[noreturn]] void refuse_kind(const char* name, const std::string& expected, const py::handle& got);

// Returns the C++ value of a Python object. Throws TypeError if the object has another
// class.
template <class T>
T& held(const py::handle& object, const char* name) {
    if (!py::isinstance<T>(object))
        refuse_kind(name, py::type::of<T>().attr("__name__").template cast<std::string>(), object);
    return object.cast<T&>();
}

// Returns the shape of an array on any device. Throws TypeError if the object has no
// shape.
std::vector<py::ssize_t> shape_of(const py::handle& array, const char* name);

// The dtype of elements, in the notation of NumPy and of __cuda_array_interface__.
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

// Memory that belongs to an array. `size` is the number of elements.
struct Borrowed {
    void* data;
    size_t size;
};

constexpr Device kHost{};

// Returns the device of an array. Throws TypeError if the array is neither a NumPy
// array nor on a device, and RuntimeError if the device's backend was not compiled.
Device device_of(const py::handle& array, const char* name);

// Returns the attribute __cuda_array_interface__ of an array, or None if there is none.
py::object cuda_interface_of(const py::handle& array);

bool fits_shape(const std::vector<py::ssize_t>& got, const Shape& wanted);

// Throws ValueError with the text "name: problem".
[[noreturn]] void refuse_value(const char* name, const std::string& problem);

// Borrows a NumPy array after checks of its dtype and shape.
Borrowed borrow_on_host(const py::handle& array, const char* name, const Element& element,
                        const Shape& shape, bool is_written);

// Borrows an array after checks of its device, dtype and shape. The caller must keep
// the array alive, and order its work on the array's stream.
Borrowed borrow(Device device, const py::handle& array, const char* name, const Element& element,
                const Shape& shape, bool is_written);

// Borrows a NumPy array. A const T means that the array is only read.
template <class T>
Span<T> span_of(const py::handle& array, const char* name, const Shape& shape) {
    const Borrowed borrowed = borrow_on_host(array, name, element_of<std::remove_const_t<T>>(),
                                             shape, !std::is_const_v<T>);
    return {static_cast<T*>(borrowed.data), borrowed.size};
}

// Borrows an array, which must be on this device.
template <class T>
Span<T> span_on(Device device, const py::handle& array, const char* name, const Shape& shape) {
    const Borrowed borrowed = borrow(device, array, name, element_of<std::remove_const_t<T>>(),
                                     shape, !std::is_const_v<T>);
    return {static_cast<T*>(borrowed.data), borrowed.size};
}

// Borrows an array like span_on(), and returns its elements. For None, returns null.
template <class T>
T* elements_or_null(Device device, const py::object& array, const char* name, const Shape& shape) {
    return array.is_none() ? nullptr : span_on<T>(device, array, name, shape).data;
}

// A new, uninitialised array, and its memory. make_array() throws MemoryError if there
// is not enough memory.
struct MadeArray {
    py::object object;
    void* data;
};
MadeArray make_array(Device device, const Element& element, const std::vector<py::ssize_t>& shape);

// A new, uninitialised array, whose elements are set through `span`.
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

// Makes an uninitialised array, stores it in `object`, and returns its elements.
template <class T>
T* new_elements(Device device, const Shape& shape, py::object& object) {
    const NewArray<T> array(device, shape);
    object = array.object;
    return array.span.data;
}

class Backend;

// A scope in which work runs on a device. The device is current, and work is enqueued
// on torch's current stream. The constructor and the destructor need the GIL, but the
// work does not. Throws RuntimeError if the device does not exist.
class Work {
  public:
    explicit Work(Device device);
    ~Work();
    Work(const Work&) = delete;
    Work& operator=(const Work&) = delete;

    Device device() const { return device_; }
    const Backend& backend() const { return backend_; }
    // Returns the stream of the backend, or null on the host.
    void* stream() const { return stream_; }

  private:
    const Device device_;
    const Backend& backend_;
    int device_before_ = 0;
    void* stream_ = nullptr;
};

}  // namespace v3dg
