// Checks and allocates arrays on the host. For arrays on other devices, these functions
// call the backend of the device.

#include "bindings/array.h"

#include "bindings/backend.h"

namespace v3dg {

namespace {

constexpr const char* kInterface = "__cuda_array_interface__";

std::string text_of(const py::handle& value) { return py::str(value).cast<std::string>(); }

}  // namespace

void refuse_value(const char* name, const std::string& problem) {
    throw py::value_error(std::string(name) + ": " + problem);
}

void refuse_kind(const char* name, const std::string& expected, const py::handle& got) {
    throw py::type_error(std::string(name) + ": expected " + expected + ", got " +
                         text_of(py::type::handle_of(got)));
}

std::string shape_text(const Shape& shape) {
    std::string text;
    for (const py::ssize_t length : shape)
        text +=
            (text.empty() ? "" : ", ") + (length < 0 ? std::string("N") : std::to_string(length));
    return "(" + text + (shape.size() == 1 ? ",)" : ")");
}

std::string shape_text(const py::handle& array) {
    return text_of(py::tuple(py::getattr(array, "shape", py::tuple())));
}

bool fits_shape(const std::vector<py::ssize_t>& got, const Shape& wanted) {
    if (got.size() != wanted.size()) return false;
    size_t axis = 0;
    for (const py::ssize_t length : wanted)
        if (const py::ssize_t here = got[axis++]; length >= 0 && here != length) return false;
    return true;
}

std::vector<py::ssize_t> shape_of(const py::handle& array, const char* name) {
    if (!py::hasattr(array, "shape")) refuse_kind(name, "an array", array);
    return py::tuple(array.attr("shape")).cast<std::vector<py::ssize_t>>();
}

py::object cuda_interface_of(const py::handle& array) {
    PyObject* found = PyObject_GetAttrString(array.ptr(), kInterface);
    if (found != nullptr) return py::reinterpret_steal<py::object>(found);
    // Pass on all other errors, such as KeyboardInterrupt.
    if (!PyErr_ExceptionMatches(PyExc_AttributeError)) throw py::error_already_set();
    PyErr_Clear();
    return py::none();
}

Device device_of(const py::handle& array, const char* name) {
    if (py::isinstance<py::array>(array)) return kHost;
    const Backend* const backend = device_backend();
    if (backend != nullptr) {
        if (const std::optional<Device> device = backend->device_of(array)) return *device;
    } else if (!cuda_interface_of(array).is_none()) {
        throw std::runtime_error(std::string(name) + ": this array is on a CUDA device, but " +
                                 kWithoutCuda);
    }
    refuse_kind(name, "a NumPy array or an array on a CUDA device", array);
}

Borrowed borrow_on_host(const py::handle& array, const char* name, const Element& element,
                        const Shape& shape, bool is_written) {
    if (!py::isinstance<py::array>(array)) refuse_kind(name, "a NumPy array", array);
    const auto got = py::reinterpret_borrow<py::array>(array);
    const py::dtype dtype = element.dtype();
    if (!got.dtype().equal(dtype))
        refuse_value(name, "expected dtype " + text_of(dtype) + ", got " + text_of(got.dtype()));
    const std::vector<py::ssize_t> lengths(got.shape(), got.shape() + got.ndim());
    if (!fits_shape(lengths, shape))
        refuse_value(name, "expected shape " + shape_text(shape) + ", got " + shape_text(got));
    if (!(got.flags() & py::array::c_style))
        refuse_value(
            name, "expected a C-contiguous array, got a strided one; call numpy.ascontiguousarray");
    if (is_written && !got.writeable())
        refuse_value(name, "expected a writable array, got a read-only one");
    return {.data = const_cast<void*>(got.data()), .size = static_cast<size_t>(got.size())};
}

Borrowed borrow(Device device, const py::handle& array, const char* name, const Element& element,
                const Shape& shape, bool is_written) {
    return backend_of(device).borrow(device, array, name, element, shape, is_written);
}

MadeArray make_array(Device device, const Element& element, const std::vector<py::ssize_t>& shape) {
    return backend_of(device).make_array(device, element, shape);
}

Work::Work(Device device) : device_(device), backend_(backend_of(device)) {
    const Entered entered = backend_.enter(device);
    device_before_ = entered.device_before;
    stream_ = entered.stream;
}

Work::~Work() { backend_.leave(device_, device_before_); }

}  // namespace v3dg
