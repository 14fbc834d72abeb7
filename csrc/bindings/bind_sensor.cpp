// Bindings of channels and of layers of meshes.

#include "bindings/sensor.h"

#include "bindings/operations.h"

namespace v3dg {

namespace {

bool& channel_of(Channels& channels, const std::string& name) {
    if (name == "median_depth") return channels.median_depth;
    if (name == "normal") return channels.normal;
    if (name == "instance") return channels.instance;
    if (name == "label") return channels.label;
    if (name == "weight") return channels.weight;
    if (name == "clipped") return channels.clipped;
    throw py::value_error("channels: expected names of channels, got '" + name + "'");
}

// Borrows a plane of a mesh with `channels` numbers a pixel. `channels` is 0 for a
// plane without an axis of channels. Returns null for None.
template <class T>
const T* plane_of(Device device, const py::object& array, const char* name,
                  const std::vector<py::ssize_t>& shape, py::ssize_t channels) {
    if (array.is_none()) return nullptr;
    const py::ssize_t a = shape[0], b = shape[1];
    if (shape.size() == 2) {
        if (channels == 0) return span_on<const T>(device, array, name, {a, b}).data;
        return span_on<const T>(device, array, name, {a, b, channels}).data;
    }
    const py::ssize_t c = shape[2];
    if (channels == 0) return span_on<const T>(device, array, name, {a, b, c}).data;
    return span_on<const T>(device, array, name, {a, b, c, channels}).data;
}

}  // namespace

SensorPlanes NewChannels::allocate(Device device, const Channels& channels,
                                   const std::vector<py::ssize_t>& shape, SensorPlanes planes) {
    std::vector<py::ssize_t> with_axes = shape;
    with_axes.push_back(3);
    const auto made = [&]<class T>(bool is_wanted, const std::vector<py::ssize_t>& of_plane,
                                   py::object& object, T*& plane) {
        if (!is_wanted || plane != nullptr) return;
        const NewArray<T> array(device, of_plane);
        object = array.object;
        plane = array.span.data;
    };
    made(channels.median_depth, shape, median_depth, planes.median_depth);
    made(channels.normal, with_axes, normal, planes.normal);
    made(channels.instance, shape, instance, planes.instance);
    made(channels.label, shape, label, planes.label);
    made(channels.weight, shape, weight, planes.weight);
    made(channels.clipped, shape, clipped, planes.clipped);
    return planes;
}

BoundMesh::BoundMesh(py::object color, py::object depth, py::object coverage, py::object normal,
                     py::object instance, py::object label, bool is_linear)
    : arrays_{std::move(color),  std::move(depth),    std::move(coverage),
              std::move(normal), std::move(instance), std::move(label)},
      shape_(shape_of(arrays_[1], "depth")),
      device_(device_of(arrays_[1], "depth")) {
    if (shape_.size() != 2 && shape_.size() != 3)
        refuse_value("depth", "expected shape (H, W) or (B, H, W), got " + shape_text(arrays_[1]));
    layer_.color = plane_of<float>(device_, arrays_[0], "color", shape_, 3);
    layer_.depth = plane_of<float>(device_, arrays_[1], "depth", shape_, 0);
    layer_.coverage = plane_of<float>(device_, arrays_[2], "coverage", shape_, 0);
    layer_.normal = plane_of<float>(device_, arrays_[3], "normal", shape_, 3);
    layer_.instance = plane_of<int32_t>(device_, arrays_[4], "instance", shape_, 0);
    layer_.label = plane_of<int32_t>(device_, arrays_[5], "label", shape_, 0);
    if (layer_.color == nullptr)
        throw py::value_error("mesh: expected an array of colour, got None");
    if (layer_.coverage == nullptr && device_ == kHost)
        throw py::value_error("mesh: expected an array of coverage on the CPU, got None");
    layer_.light = is_linear ? MeshLight::linear : MeshLight::display;
}

void BoundMesh::check(const std::vector<py::ssize_t>& shape) const {
    if (shape_ == shape) return;
    std::string expected;
    for (const py::ssize_t size : shape) {
        if (!expected.empty()) expected += ", ";
        expected += std::to_string(size);
    }
    refuse_value("mesh", "expected planes of shape (" + expected + "), as the picture has, got " +
                             shape_text(arrays_[1]));
}

BoundSensor::BoundSensor(const std::vector<std::string>& channels, py::object mesh)
    : mesh_(std::move(mesh)) {
    for (const std::string& name : channels) channel_of(channels_, name) = true;
    if (!mesh_.is_none()) held<BoundMesh>(mesh_, "mesh");
}

SensorRequest BoundSensor::request(const std::vector<py::ssize_t>& shape) const {
    SensorRequest request{.channels = channels_, .mesh = {}};
    if (mesh_.is_none()) return request;
    const auto& mesh = held<BoundMesh>(mesh_, "mesh");
    mesh.check(shape);
    request.mesh = mesh.layer();
    return request;
}

void BoundSensor::check_device(Device device) const {
    if (!mesh_.is_none() && held<BoundMesh>(mesh_, "mesh").device() != device)
        refuse_value("mesh", "expected arrays on the device that draws, got others");
}

void bind_sensor(py::module_& m) {
    py::class_<NewChannels>(m, "Channels", "The channels of a picture beside colour.")
        .def_readonly("median_depth", &NewChannels::median_depth)
        .def_readonly("normal", &NewChannels::normal)
        .def_readonly("instance", &NewChannels::instance)
        .def_readonly("label", &NewChannels::label)
        .def_readonly("weight", &NewChannels::weight)
        .def_readonly("clipped", &NewChannels::clipped);
    py::class_<BoundMesh>(m, "Mesh", "The z-buffer of a picture of meshes; borrows the arrays.")
        .def(py::init<py::object, py::object, py::object, py::object, py::object, py::object,
                      bool>(),
             py::kw_only(), "color"_a, "depth"_a, "coverage"_a, "normal"_a = py::none(),
             "instance"_a = py::none(), "label"_a = py::none(), "is_linear"_a = false);
    py::class_<BoundSensor>(m, "Sensor", "The channels and the meshes of a request.")
        .def(py::init<const std::vector<std::string>&, py::object>(), "channels"_a,
             "mesh"_a = py::none());
}

}  // namespace v3dg
