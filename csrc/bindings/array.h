#pragma once

// Arrays that users hold: NumPy's on the host; on a CUDA device whatever has
// __cuda_array_interface__, such as torch's tensors. They are borrowed after checks of kind, dtype,
// shape and layout, never copied.

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <initializer_list>
#include <memory>
#include <string>
#include <type_traits>

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

// The shape of an array on either side; TypeError where there is none.
std::vector<py::ssize_t> shape_of(const py::handle& array, const char* name);

// Where an array is. TypeError where it is neither NumPy's nor on a CUDA device, RuntimeError where
// that needs a v3dg built with CUDA.
Device device_of(const py::handle& array, const char* name);

// Memory after checks that it is an array on the host, or on a device, of this dtype and shape.
void* host_memory(const py::handle& array, const char* name, const py::dtype& dtype, Shape shape,
                  bool is_written, size_t& size);
void* device_memory(const py::handle& array, const char* name, const std::string& typestr,
                    Shape shape, size_t& size);

// Borrows an array on the host; T is const where it is only read.
template <class T>
Span<T> span_of(const py::handle& array, const char* name, Shape shape) {
    using Value = std::remove_const_t<T>;
    size_t size = 0;
    void* data =
        host_memory(array, name, py::dtype::of<Value>(), shape, !std::is_const<T>::value, size);
    return {static_cast<T*>(data), size};
}

// Borrows an array on a CUDA device; the caller keeps it alive and its stream ordered.
template <class T>
Span<T> device_span_of(const py::handle& array, const char* name, Shape shape) {
    using Value = std::remove_const_t<T>;
    static const std::string typestr =
        py::dtype::of<Value>().attr("str").template cast<std::string>();
    size_t size = 0;
    void* data = device_memory(array, name, typestr, shape, size);
    return {static_cast<T*>(data), size};
}

// ValueError where memory is another CUDA device's.
void check_is_on(Device device, const void* memory, const char* name);

// Borrows an array that has to be where others are.
template <class T>
Span<T> span_on(Device device, const py::handle& array, const char* name, Shape shape) {
    if (device.is_host()) return span_of<T>(array, name, shape);
    const Span<T> span = device_span_of<T>(array, name, shape);
    check_is_on(device, span.data, name);
    return span;
}

// A new array, not initialised: NumPy's on the host, a torch tensor on a device. Too little memory
// there is a MemoryError.
py::object new_array(Device device, const py::dtype& dtype, const std::vector<py::ssize_t>& shape);

// The same, borrowed to be filled in.
template <class T>
struct NewArray {
    py::object object;
    Span<T> span;

    NewArray(Device device, const std::vector<py::ssize_t>& shape)
        : object(new_array(device, py::dtype::of<T>(), shape)) {
        if (device.is_host()) {
            auto array = py::reinterpret_borrow<py::array>(object);
            span = {static_cast<T*>(array.mutable_data()), static_cast<size_t>(array.size())};
        } else {
            size_t size = 1;
            for (const py::ssize_t length : shape) size *= static_cast<size_t>(length);
            span = {reinterpret_cast<T*>(object.attr("data_ptr")().cast<uintptr_t>()), size};
        }
    }
};

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
    cuda::Stream stream() const { return stream_; }

  private:
    struct Guard;
    Device device_;
    cuda::Stream stream_ = nullptr;
    std::unique_ptr<Guard> guard_;
};

}  // namespace v3dg
