// Cameras of a batch for Python, and checks of their arrays.

#include <string>

#include "bindings/backend.h"
#include "bindings/operations.h"
#include "camera/camera_arrays.h"

namespace v3dg {

namespace {

bool has_dtype(const py::object& array, const char* name) {
    const auto dtype = py::str(array.attr("dtype")).cast<std::string>();
    return dtype == name || dtype == std::string("torch.") + name;
}

const char* expected_of(CameraFault fault) {
    switch (fault) {
        case CameraFault::not_finite: return "finite numbers";
        case CameraFault::no_rotation: return "a rotation in the upper left 3x3";
        case CameraFault::last_row: return "the last row 0 0 0 1";
        case CameraFault::focal_length: return "positive focal lengths";
        default: return "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]";
    }
}

// Returns the index of the first invalid camera, and what was expected of it. If all
// cameras are valid, returns None. The arrays must be on the host.
py::object fault_of_cameras(const py::array& viewmats, const py::array& K) {
    const Span<const double> poses = span_of<const double>(viewmats, "viewmats", {-1, 4, 4});
    const auto count = static_cast<py::ssize_t>(poses.size / 16);
    const Span<const double> lenses = span_of<const double>(K, "K", {count, 3, 3});
    for (py::ssize_t b = 0; b < count; ++b) {
        const CameraFault fault = fault_of_camera(poses.data + 16 * b, lenses.data + 9 * b);
        if (fault != CameraFault::none) return py::make_tuple(b, expected_of(fault));
    }
    return py::none();
}

}  // namespace

Reals reals_of(Device device, const py::object& array, const char* name, const Shape& shape) {
    if (device != kHost && has_dtype(array, "float32"))
        return {.data = span_on<const float>(device, array, name, shape).data, .are_double = false};
    return {.data = span_on<const double>(device, array, name, shape).data, .are_double = true};
}

Wholes wholes_of(Device device, const py::object& array, const char* name, const Shape& shape) {
    if (array.is_none()) return {};
    if (device != kHost && has_dtype(array, "int64"))
        return {.data = span_on<const int64_t>(device, array, name, shape).data, .are_long = true};
    return {.data = span_on<const int32_t>(device, array, name, shape).data, .are_long = false};
}

void check_environments(Device device, const Wholes& environments, size_t count,
                        const EnvironmentTable& table, const char* name) {
    if (device != kHost || environments.data == nullptr) return;
    const auto* environment = static_cast<const int32_t*>(environments.data);
    for (size_t b = 0; b < count; ++b)
        if (environment[b] < kShared || environment[b] >= table.num_environments())
            throw py::value_error(name + ("[" + std::to_string(b)) + "]: expected -1 to " +
                                  std::to_string(table.num_environments() - 1) +
                                  ", as the scene has, got " + std::to_string(environment[b]));
}

BoundCameras::BoundCameras(py::object viewmats, py::object K, int width, int height, double near,
                           py::object environments,
                           const std::optional<std::vector<BoundCamera>>& lenses)
    : viewmats_object_(std::move(viewmats)),
      intrinsics_object_(std::move(K)),
      environments_object_(std::move(environments)),
      device_(device_of(viewmats_object_, "viewmats")),
      width_(width),
      height_(height),
      near_depth_(near) {
    check_image_size(width, height);
    viewmats_ = reals_of(device_, viewmats_object_, "viewmats", {-1, 4, 4});
    const auto count = shape_of(viewmats_object_, "viewmats")[0];
    size_ = static_cast<size_t>(count);
    shares_intrinsics_ = shape_of(intrinsics_object_, "K").size() == 2;
    if (shares_intrinsics_)
        intrinsics_ = reals_of(device_, intrinsics_object_, "K", {3, 3});
    else
        intrinsics_ = reals_of(device_, intrinsics_object_, "K", {count, 3, 3});
    if (lenses) {
        check_is_on_host(device_, "lenses", "expected cameras on the CPU, got arrays on a device");
        bool fits = lenses->size() == size_;
        for (const BoundCamera& camera : *lenses)
            fits = fits && camera.width() == width && camera.height() == height;
        if (!fits) refuse_value("lenses", "expected one camera of this size for each pose");
        for (const BoundCamera& camera : *lenses) lenses_.push_back(camera.camera);
    }
    environments_ = wholes_of(device_, environments_object_, "environments", {count});
}

std::vector<Camera> BoundCameras::on_host() const {
    if (!lenses_.empty()) return lenses_;
    const auto* viewmats = static_cast<const double*>(viewmats_.data);
    const auto* intrinsics = static_cast<const double*>(intrinsics_.data);
    const size_t stride = shares_intrinsics_ ? 0 : 9;
    std::vector<Camera> cameras;
    cameras.reserve(size_);
    for (size_t b = 0; b < size_; ++b)
        cameras.push_back(
            camera_of(viewmats + 16 * b, intrinsics + stride * b, width_, height_, near_depth_));
    return cameras;
}

BoundPlanes::BoundPlanes(py::object color, py::object alpha, py::object depth, NewChannels channels)
    : color_(std::move(color)),
      alpha_(std::move(alpha)),
      depth_(std::move(depth)),
      channels_(std::move(channels)),
      device_(device_of(color_, "color")) {
    const std::vector<py::ssize_t> shape = shape_of(color_, "color");
    const bool fits = shape.size() == 4 && (shape[3] == 3 || shape[3] == 4);
    if (!fits)
        refuse_value("color",
                     "expected shape (B, H, W, 3) or (B, H, W, 4), got " + shape_text(color_));
    count_ = shape[0];
    height_ = shape[1];
    width_ = shape[2];
    planes_.channels = static_cast<int>(shape[3]);
    if (planes_.channels == 4 && !alpha_.is_none())
        refuse_value("alpha", "colour has alpha as its fourth channel; leave it out");
    planes_.color =
        span_on<float>(device_, color_, "color", {count_, height_, width_, shape[3]}).data;
    const Shape of_plane{count_, height_, width_};
    const Shape with_axes{count_, height_, width_, 3};
    const auto floats = [&](const py::object& array, const char* name, const Shape& wanted) {
        return elements_or_null<float>(device_, array, name, wanted);
    };
    const auto ints = [&](const py::object& array, const char* name) {
        return elements_or_null<int32_t>(device_, array, name, of_plane);
    };
    planes_.alpha = floats(alpha_, "alpha", of_plane);
    planes_.depth = floats(depth_, "depth", of_plane);
    sensor_planes_ = {.median_depth = floats(channels_.median_depth, "median_depth", of_plane),
                      .normal = floats(channels_.normal, "normal", with_axes),
                      .instance = ints(channels_.instance, "instance"),
                      .label = ints(channels_.label, "label"),
                      .weight = floats(channels_.weight, "weight", of_plane),
                      .clipped = nullptr};
}

BoundPlanes::BoundPlanes(const BoundCameras& cameras, Device device, bool with_depth)
    : depth_(py::none()),
      device_(device),
      count_(static_cast<py::ssize_t>(cameras.size())),
      height_(cameras.height()),
      width_(cameras.width()) {
    const Shape of_plane{count_, height_, width_};
    planes_.channels = 3;
    planes_.color = new_elements<float>(device, {count_, height_, width_, 3}, color_);
    planes_.alpha = new_elements<float>(device, of_plane, alpha_);
    if (with_depth) planes_.depth = new_elements<float>(device, of_plane, depth_);
}

void BoundPlanes::check(const BoundCameras& cameras, Device device) const {
    if (device_ != device) refuse_value("out", "expected planes on the device that draws");
    const bool fits = count_ == static_cast<py::ssize_t>(cameras.size()) &&
                      height_ == cameras.height() && width_ == cameras.width();
    if (fits) return;
    const auto channels = static_cast<py::ssize_t>(planes_.channels);
    const auto count = static_cast<py::ssize_t>(cameras.size());
    refuse_value("color", "expected shape " +
                              shape_text({count, cameras.height(), cameras.width(), channels}) +
                              ", as the cameras have, got " + shape_text(color_));
}

void bind_batch(py::module_& m) {
    m.def("fault_of_cameras", &fault_of_cameras, "viewmats"_a, "K"_a);
    py::class_<BoundCameras>(m, "Cameras", "The cameras of a batch; borrows the arrays.")
        .def(py::init<py::object, py::object, int, int, double, py::object,
                      const std::optional<std::vector<BoundCamera>>&>(),
             py::kw_only(), "viewmats"_a, "K"_a, "width"_a, "height"_a, "near"_a,
             "environments"_a = py::none(), "lenses"_a = py::none())
        .def("__len__", &BoundCameras::size);
    py::class_<BoundPlanes>(m, "BatchPlanes", "The planes of a batch; keeps the arrays.")
        .def(py::init([](py::object color, py::object alpha, py::object depth,
                         py::object median_depth, py::object normal, py::object instance,
                         py::object label, py::object weight) {
                 NewChannels channels;
                 channels.median_depth = std::move(median_depth);
                 channels.normal = std::move(normal);
                 channels.instance = std::move(instance);
                 channels.label = std::move(label);
                 channels.weight = std::move(weight);
                 return BoundPlanes(std::move(color), std::move(alpha), std::move(depth),
                                    std::move(channels));
             }),
             "color"_a, "alpha"_a = py::none(), "depth"_a = py::none(), py::kw_only(),
             "median_depth"_a = py::none(), "normal"_a = py::none(), "instance"_a = py::none(),
             "label"_a = py::none(), "weight"_a = py::none());
    py::class_<BatchStats>(m, "BatchStats", "The statistics of each picture of a batch.")
        .def_readonly("gaussians", &BatchStats::gaussians)
        .def_readonly("in_frustum", &BatchStats::in_frustum)
        .def_readonly("select_ms", &BatchStats::select_ms)
        .def_readonly("draw_ms", &BatchStats::draw_ms)
        .def_readonly("levels", &BatchStats::levels)
        .def_readonly("num_parts", &BatchStats::num_parts);
    py::class_<BoundBatch>(m, "Batch", "Pictures that have been drawn, or enqueued on a device.")
        .def_readonly("color", &BoundBatch::color)
        .def_readonly("alpha", &BoundBatch::alpha)
        .def_readonly("depth", &BoundBatch::depth)
        .def_readonly("channels", &BoundBatch::channels)
        .def("finish", &BoundBatch::finish, "Waits for the pictures.")
        .def("stats", &BoundBatch::stats);
}

}  // namespace v3dg
