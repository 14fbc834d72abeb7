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

}  // namespace

SensorPlanes NewChannels::allocate(Device device, const Channels& channels,
                                   const std::vector<py::ssize_t>& shape, SensorPlanes planes) {
    std::vector<py::ssize_t> with_axes = shape;
    with_axes.push_back(3);
    const auto made = [&]<class T>(bool is_wanted, const std::vector<py::ssize_t>& of_plane,
                                   py::object& object, T*& plane) {
        if (is_wanted && plane == nullptr) plane = new_elements<T>(device, of_plane, object);
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
    Shape with_axes = shape_;
    with_axes.push_back(3);
    const auto floats = [&](const py::object& array, const char* name, const Shape& wanted) {
        return elements_or_null<const float>(device_, array, name, wanted);
    };
    const auto ints = [&](const py::object& array, const char* name) {
        return elements_or_null<const int32_t>(device_, array, name, shape_);
    };
    layer_.color = floats(arrays_[0], "color", with_axes);
    layer_.depth = floats(arrays_[1], "depth", shape_);
    layer_.coverage = floats(arrays_[2], "coverage", shape_);
    layer_.normal = floats(arrays_[3], "normal", with_axes);
    layer_.instance = ints(arrays_[4], "instance");
    layer_.label = ints(arrays_[5], "label");
    if (layer_.color == nullptr)
        throw py::value_error("mesh: expected an array of colour, got None");
    if (layer_.coverage == nullptr && device_ == kHost)
        throw py::value_error("mesh: expected an array of coverage on the CPU, got None");
    layer_.light = is_linear ? MeshLight::linear : MeshLight::display;
}

BoundMesh BoundMesh::of_eye(int number) const {
    if (shape_.size() != 3 || shape_[0] != 2)
        refuse_value("mesh", "expected planes of shape (2, H, W) for two eyes, got " +
                                 shape_text(arrays_[1]));
    std::vector<py::object> planes;
    for (const py::object& array : arrays_)
        planes.push_back(array.is_none() ? array : py::object(array[py::int_(number)]));
    return {planes[0],
            planes[1],
            planes[2],
            planes[3],
            planes[4],
            planes[5],
            layer_.light == MeshLight::linear};
}

void BoundMesh::check(const std::vector<py::ssize_t>& shape) const {
    if (shape_ == shape) return;
    refuse_value("mesh", "expected planes of shape " + shape_text(shape) +
                             ", as the picture has, got " + shape_text(arrays_[1]));
}

BoundSensor::BoundSensor(const std::vector<std::string>& channels, py::object mesh)
    : mesh_(std::move(mesh)) {
    for (const std::string& name : channels) channel_of(channels_, name) = true;
    if (!mesh_.is_none()) held<BoundMesh>(mesh_, "mesh");
}

BoundSensor BoundSensor::of_eye(int number) const {
    BoundSensor eye = *this;
    if (!mesh_.is_none()) eye.mesh_ = py::cast(held<BoundMesh>(mesh_, "mesh").of_eye(number));
    return eye;
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
             "mesh"_a = py::none())
        .def("of_eye", &BoundSensor::of_eye, "number"_a,
             "Return the sensor with the meshes of one of two eyes.");
}

}  // namespace v3dg
