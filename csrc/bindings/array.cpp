#include "bindings/array.h"

#include <pybind11/gil_safe_call_once.h>

#if V3DG_WITH_CUDA
#include "base/device_guard.h"
#endif

namespace v3dg {

namespace {

constexpr const char* kInterface = "__cuda_array_interface__";
#if !V3DG_WITH_CUDA
constexpr const char* kWithoutCuda =
    "v3dg was built without CUDA; install it again where nvcc is found";
#endif

std::string text_of(const py::handle& value) { return py::str(value).cast<std::string>(); }

[[noreturn]] void refuse(const char* name, const std::string& problem) {
    throw py::value_error(std::string(name) + ": " + problem);
}

// The description of an array on a device; none where it is not one.
py::object interface_of(const py::handle& array) {
    PyObject* found = PyObject_GetAttrString(array.ptr(), kInterface);
    if (found != nullptr) return py::reinterpret_steal<py::object>(found);
    // An interrupt may arrive here, too.
    if (!PyErr_ExceptionMatches(PyExc_AttributeError)) throw py::error_already_set();
    PyErr_Clear();
    return py::none();
}

// What is asked of torch for every frame, looked up once. It stays to the end of the process, which
// may come after Python's.
struct Torch {
    py::object empty, current_stream;  // the stream as a number

    static const Torch& get() {
        PYBIND11_CONSTINIT static py::gil_safe_call_once_and_store<Torch> known;
        return known.call_once_and_store_result([] { return Torch(); }).get_stored();
    }

    const py::object& dtype(const py::dtype& wanted) const {
        if (wanted.kind() == 'f') return float32_;
        return wanted.itemsize() == 8 ? int64_ : wanted.itemsize() == 4 ? int32_ : uint8_;
    }

  private:
    Torch()
        : empty(py::module_::import("torch").attr("empty")),
          current_stream(initialised_cuda().attr("_C").attr("_cuda_getCurrentRawStream")),
          float32_(py::module_::import("torch").attr("float32")),
          int64_(py::module_::import("torch").attr("int64")),
          int32_(py::module_::import("torch").attr("int32")),
          uint8_(py::module_::import("torch").attr("uint8")) {}

    // Torch, with CUDA ready for what does not see to that itself.
    static py::module_ initialised_cuda() {
        py::module_::import("torch.cuda").attr("init")();
        return py::module_::import("torch");
    }

    py::object float32_, int64_, int32_, uint8_;
};

template <class Lengths>
bool fits_shape(const Lengths& got, Shape wanted) {
    if (got.size() != wanted.size()) return false;
    size_t axis = 0;
    for (const py::ssize_t length : wanted)
        if (const py::ssize_t here = got[axis++]; length >= 0 && here != length) return false;
    return true;
}

std::vector<py::ssize_t> lengths_of(const py::array& array) {
    return std::vector<py::ssize_t>(array.shape(), array.shape() + array.ndim());
}

}  // namespace

void refuse_kind(const char* name, const std::string& expected, const py::handle& got) {
    throw py::type_error(std::string(name) + ": expected " + expected + ", got " +
                         text_of(py::type::handle_of(got)));
}

std::string shape_text(Shape shape) {
    std::string text;
    for (const py::ssize_t length : shape)
        text +=
            (text.empty() ? "" : ", ") + (length < 0 ? std::string("N") : std::to_string(length));
    return "(" + text + (shape.size() == 1 ? ",)" : ")");
}

std::string shape_text(const py::handle& array) {
    return text_of(py::tuple(py::getattr(array, "shape", py::tuple())));
}

std::vector<py::ssize_t> shape_of(const py::handle& array, const char* name) {
    if (!py::hasattr(array, "shape")) refuse_kind(name, "an array", array);
    return py::tuple(array.attr("shape")).cast<std::vector<py::ssize_t>>();
}

Device device_of(const py::handle& array, const char* name) {
    if (py::isinstance<py::array>(array)) return {};
    const py::object face = interface_of(array);
    if (face.is_none()) refuse_kind(name, "a NumPy array or an array on a CUDA device", array);
#if V3DG_WITH_CUDA
    const auto pointer = py::dict(face)["data"].cast<py::tuple>()[0].cast<uintptr_t>();
    cudaPointerAttributes attributes{};
    if (pointer != 0 &&
        cudaPointerGetAttributes(&attributes, reinterpret_cast<const void*>(pointer)) ==
            cudaSuccess &&
        attributes.type == cudaMemoryTypeDevice)
        return {attributes.device};
    cudaGetLastError();
    // An array of no elements has no memory. Torch knows where it is all the same; any other is as
    // good as on the current device.
    const py::object index =
        py::getattr(py::getattr(array, "device", py::none()), "index", py::none());
    if (py::isinstance<py::int_>(index)) return {index.cast<int>()};
    int current = 0;
    if (cudaGetDevice(&current) != cudaSuccess) cudaGetLastError();
    return {current};
#else
    throw std::runtime_error(std::string(name) +
                             ": expected a NumPy array, got one on a CUDA device, and " +
                             kWithoutCuda);
#endif
}

void* host_memory(const py::handle& array, const char* name, const py::dtype& dtype, Shape shape,
                  bool is_written, size_t& size) {
    if (!py::isinstance<py::array>(array)) refuse_kind(name, "a NumPy array", array);
    const auto got = py::reinterpret_borrow<py::array>(array);
    if (!got.dtype().equal(dtype))
        refuse(name, "expected dtype " + text_of(dtype) + ", got " + text_of(got.dtype()));
    if (!fits_shape(lengths_of(got), shape))
        refuse(name, "expected shape " + shape_text(shape) + ", got " + shape_text(got));
    if (!(got.flags() & py::array::c_style))
        refuse(name,
               "expected a C-contiguous array, got a strided one; call numpy.ascontiguousarray");
    if (is_written && !got.writeable()) refuse(name, "expected an array that can be written to");
    size = static_cast<size_t>(got.size());
    return const_cast<void*>(got.data());
}

void* device_memory(const py::handle& array, const char* name, const std::string& typestr,
                    Shape shape, size_t& size) {
    const py::object found = interface_of(array);
    if (found.is_none()) refuse_kind(name, "an array on a CUDA device", array);
    const py::dict face(found);
    const std::string dtype = face["typestr"].cast<std::string>();
    if (dtype != typestr) refuse(name, "expected dtype " + typestr + ", got " + dtype);
    const auto lengths = face["shape"].cast<py::tuple>().cast<std::vector<py::ssize_t>>();
    if (!fits_shape(lengths, shape))
        refuse(name, "expected shape " + shape_text(shape) + ", got " + text_of(face["shape"]));
    if (face.contains("strides") && !face["strides"].is_none())
        refuse(name, "expected a contiguous array, got a strided one");
    size = 1;
    for (const py::ssize_t length : lengths) size *= static_cast<size_t>(length);
    return reinterpret_cast<void*>(face["data"].cast<py::tuple>()[0].cast<uintptr_t>());
}

void check_is_on([[maybe_unused]] Device device, [[maybe_unused]] const void* memory,
                 [[maybe_unused]] const char* name) {
#if V3DG_WITH_CUDA
    cudaPointerAttributes attributes{};
    if (cudaPointerGetAttributes(&attributes, memory) != cudaSuccess)
        cudaGetLastError();
    else if (attributes.type == cudaMemoryTypeDevice && attributes.device != device.number)
        refuse(name, "expected an array on cuda:" + std::to_string(device.number) +
                         " like the others, got one on cuda:" + std::to_string(attributes.device));
#endif
}

py::object new_array(Device device, const py::dtype& dtype, const std::vector<py::ssize_t>& shape) {
    if (device.is_host()) return py::array(dtype, shape);
    const Torch& torch = Torch::get();
    try {
        return torch.empty(py::tuple(py::cast(shape)), "dtype"_a = torch.dtype(dtype),
                           "device"_a = device.number);
    } catch (py::error_already_set& error) {
        if (text_of(error.type().attr("__name__")) != "OutOfMemoryError") throw;
        PyErr_SetString(PyExc_MemoryError, text_of(error.value()).c_str());
        throw py::error_already_set();
    }
}

#if V3DG_WITH_CUDA

struct Work::Guard {
    explicit Guard(int device) : guard(device) {}
    cuda::DeviceGuard guard;
};

Work::Work(Device device) : device_(device) {
    if (device.is_host()) return;
    guard_ = std::make_unique<Guard>(device.number);
    stream_ = reinterpret_cast<cuda::Stream>(
        Torch::get().current_stream(device.number).cast<uintptr_t>());
}

#else

struct Work::Guard {};

Work::Work(Device device) : device_(device) {
    if (!device.is_host()) throw std::runtime_error(std::string("device: ") + kWithoutCuda);
}

#endif

Work::~Work() = default;

}  // namespace v3dg
