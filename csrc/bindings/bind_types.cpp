// Bindings of the values that Python passes: cameras, rules, instances and rows.

#include <algorithm>
#include <cmath>

#include "bindings/backend.h"
#include "bindings/operations.h"
#include "camera/camera_arrays.h"
#include "math/sh.h"

namespace v3dg {

namespace {

using Corners = std::array<int, 4>;

void set_window(const Corners& w, Camera& camera) {
    const int width = static_cast<int>(camera.width), height = static_cast<int>(camera.height);
    if (!(0 <= w[0] && w[0] < w[2] && w[2] <= width && 0 <= w[1] && w[1] < w[3] && w[3] <= height))
        throw py::value_error("window: expected x0 < x1 and y0 < y1 within " +
                              std::to_string(width) + " x " + std::to_string(height) + " px, got " +
                              py::str(py::tuple(py::cast(w))).cast<std::string>());
    camera.x0 = w[0];
    camera.y0 = w[1];
    camera.x1 = w[2];
    camera.y1 = w[3];
}

template <size_t kCount>
std::array<double, kCount> coefficients(const std::vector<double>& distortion) {
    if (distortion.size() != kCount)
        throw py::value_error("distortion: expected " + std::to_string(kCount) +
                              " coefficients, got " + std::to_string(distortion.size()));
    std::array<double, kCount> values;
    std::copy(distortion.begin(), distortion.end(), values.begin());
    return values;
}

Intrinsics<double> with_lens(const Pinhole<double>& projection, const std::string& model,
                             const std::vector<double>& distortion) {
    if (model == "opencv")
        return intrinsics_of_opencv(projection, coefficients<8>(distortion).data());
    if (model == "fisheye")
        return intrinsics_of_fisheye(projection, coefficients<4>(distortion).data());
    if (model != "pinhole")
        throw py::value_error("model: expected pinhole, opencv or fisheye, got " + model);
    coefficients<0>(distortion);
    return intrinsics_of(projection);
}

BoundCamera make_camera(const py::array& viewmat, const py::array& K, int width, int height,
                        double near, const std::string& model,
                        const std::vector<double>& distortion) {
    check_image_size(width, height);
    const Span<const double> view = span_of<const double>(viewmat, "viewmat", {4, 4});
    const Span<const double> k = span_of<const double>(K, "K", {3, 3});
    BoundCamera out;
    std::copy(view.begin(), view.end(), out.viewmat.begin());
    out.camera = camera_of(view.data, k.data, width, height, near);
    out.camera.set_lens(with_lens(out.camera.pinhole(), model, distortion));
    return out;
}

BoundCamera window_of_camera(const BoundCamera& camera, int x0, int y0, int x1, int y1) {
    BoundCamera part = camera;
    set_window({x0, y0, x1, y1}, part.camera);
    return part;
}

py::array_t<double> position_of(const BoundCamera& camera) {
    return py::array_t<double>(3, camera.camera.eye);
}

py::array_t<double> matrix_of(const BoundCamera& bound) {
    const Camera& camera = bound.camera;
    const double K[9] = {camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1};
    return py::array_t<double>({3, 3}, K);
}

double lens_range_of(const BoundCamera& bound) {
    const Camera& camera = bound.camera;
    switch (camera.model()) {
        case LensModel::opencv: return camera.opencv().valid_slope;
        case LensModel::fisheye: return camera.fisheye().valid_angle;
        default: return INFINITY;
    }
}

BoundEyes make_eyes(const BoundCamera& left, const BoundCamera& right) {
    if (!std::equal(left.camera.rotation, left.camera.rotation + 9, right.camera.rotation))
        throw py::value_error(
            "left, right: expected cameras with the same rotation, got different rotations");
    if (!left.camera.is_pinhole() || !right.camera.is_pinhole())
        throw py::value_error("left, right: expected pinholes, got a distorted camera");
    return {Eyes(left.camera, right.camera)};
}

Footprint footprint_of(const std::string& name) {
    if (name == "solid_angle") return Footprint::solid_angle;
    if (name == "paper") return Footprint::paper;
    throw py::value_error("footprint: expected solid_angle or paper, got " + name);
}

SelectRule make_rule(double tolerance_px2, std::optional<uint64_t> budget, int32_t min_level,
                     const std::string& footprint, bool culls, double fade, int32_t frame) {
    SelectRule rule;
    rule.tolerance_px2 = static_cast<float>(tolerance_px2);
    rule.budget = budget.value_or(kNoBudget);
    rule.min_level = min_level;
    rule.footprint = footprint_of(footprint);
    rule.culls = culls;
    if (!(fade >= 1) || (fade > 1 && rule.footprint == Footprint::paper))
        throw py::value_error(
            "fade: expected 1 or more, and exactly 1 with footprint 'paper', got " +
            std::to_string(fade));
    rule.fade = {static_cast<float>(fade), 1.0f / static_cast<float>(fade)};
    rule.frame = frame;
    return rule;
}

}  // namespace

void check_footprint(const Eyes& eyes, const SelectRule& rule) {
    if (rule.footprint != Footprint::paper) return;
    if (eyes.are_two)
        throw py::value_error("footprint: expected 'solid_angle' for two eyes, got 'paper'");
    if (!eyes.camera[0].is_pinhole())
        throw py::value_error(
            "footprint: expected 'solid_angle' for a distorted camera, got 'paper'");
}

void check_image_size(int width, int height) {
    if (width < 1 || height < 1 || width > UINT16_MAX || height > UINT16_MAX)
        throw py::value_error("width, height: expected 1 to 65535 px, got " +
                              std::to_string(width) + " x " + std::to_string(height));
}

int degree_of_bases(py::ssize_t bases, const std::string& shape) {
    int degree = 0;
    while (degree <= 3 && num_sh_bases(degree) != bases) ++degree;
    if (degree > 3)
        throw py::value_error("sh: expected shape (N, K, 3) with K = 1, 4, 9 or 16, got " + shape);
    return degree;
}

Rows::Rows(py::object means, py::object quats, py::object scales, py::object opacities,
           py::object sh)
    : arrays_{std::move(means), std::move(quats), std::move(scales), std::move(opacities),
              std::move(sh)},
      device_(device_of(arrays_[0], "means")) {
    const std::vector<py::ssize_t> shape = shape_of(arrays_[4], "sh");
    sh_degree_ = degree_of_bases(shape.size() == 3 ? shape[1] : -1, shape_text(arrays_[4]));
    const std::vector<py::ssize_t> centers = shape_of(arrays_[0], "means");
    if (centers.size() != 2)
        throw py::value_error("means: expected shape (N, 3), got " + shape_text(arrays_[0]));
    size_ = static_cast<size_t>(centers[0]);
    const BackendTraits& traits = backend_of(device_).traits;
    is_double_ = traits.computes_doubles && py::isinstance<py::array_t<double>>(arrays_[0]);
    if (is_double_) {
        remember(spans<const double>());
        return;
    }
    const GaussianRows<const float> rows = spans<const float>();
    remember(rows);
    for (const float* start : {rows.quats, rows.sh})
        if (reinterpret_cast<uintptr_t>(start) % traits.row_alignment != 0)
            throw py::value_error("quats, sh: expected memory that is aligned to " +
                                  std::to_string(traits.row_alignment) + " bytes; copy the arrays");
}

void Rows::check_precision(bool wants_double) const {
    if (wants_double != is_double_)
        throw py::value_error(std::string("means: expected dtype ") +
                              (wants_double ? "float64" : "float32") + ", got " +
                              (is_double_ ? "float64" : "float32"));
}

NewRows::NewRows(Device device, size_t size, int sh_degree)
    : means(device, {static_cast<py::ssize_t>(size), 3}),
      quats(device, {static_cast<py::ssize_t>(size), 4}),
      scales(device, {static_cast<py::ssize_t>(size), 3}),
      opacities(device, {static_cast<py::ssize_t>(size)}),
      sh(device, {static_cast<py::ssize_t>(size), num_sh_bases(sh_degree), 3}),
      size(size),
      sh_degree(sh_degree) {}

Instances::Instances(py::array bundle, py::array positions, py::array quaternions, py::array scales,
                     py::array importance, py::object factors)
    : arrays_{bundle, positions, quaternions, scales, importance, factors} {
    table_.bundle = span_of<const int32_t>(bundle, "bundle", {-1});
    const auto count = static_cast<py::ssize_t>(table_.bundle.size);
    table_.position = span_of<const double>(positions, "positions", {count, 3});
    table_.quaternion = span_of<const double>(quaternions, "quaternions", {count, 4});
    table_.scale = span_of<const double>(scales, "scales", {count});
    table_.importance = span_of<const float>(importance, "importance", {count});
    table_.factors = factors_of(factors, count);
}

Span<const InstanceFactors> factors_of(const py::object& factors, py::ssize_t count) {
    static_assert(sizeof(InstanceFactors) == 4 * sizeof(float),
                  "InstanceFactors must have the layout of a row of four floats");
    if (factors.is_none()) return {};
    const Span<const float> rows = span_of<const float>(factors, "factors", {count, 4});
    return {reinterpret_cast<const InstanceFactors*>(rows.data), static_cast<size_t>(count)};
}

void Instances::check_bundles(size_t num_bundles) const {
    check_instance_bundles(table_.bundle, num_bundles);
}

void check_instance_bundles(Span<const int32_t> bundle, size_t num_bundles) {
    for (const int32_t b : bundle)
        if (b < 0 || static_cast<size_t>(b) >= num_bundles)
            throw py::value_error("bundle: expected an index below " + std::to_string(num_bundles) +
                                  ", got " + std::to_string(b));
}

Span<const int64_t> offsets_of(const py::handle& offset, size_t last) {
    const Span<const int64_t> values = span_of<const int64_t>(offset, "offset", {-1});
    bool good =
        values.size > 0 && values[0] == 0 && values[values.size - 1] == static_cast<int64_t>(last);
    for (size_t i = 1; good && i < values.size; ++i) good = values[i - 1] <= values[i];
    if (!good)
        throw py::value_error("offset: expected ascending boundaries from 0 to " +
                              std::to_string(last) + ", got other numbers");
    return values;
}

Window window_of(const Camera& c) {
    return {static_cast<int>(c.x0), static_cast<int>(c.y0), static_cast<int>(c.x1),
            static_cast<int>(c.y1)};
}

py::object sh_bases_of(int degree, const py::array& directions) {
    if (degree < 0 || degree > kMaxShDegree)
        throw py::value_error("degree: expected 0 to 3, got " + std::to_string(degree));
    const Span<const double> in = span_of<const double>(directions, "directions", {-1, 3});
    const auto count = static_cast<py::ssize_t>(in.size / 3);
    const int num_bases = num_sh_bases(degree);
    const NewArray<double> out({}, {count, num_bases});
    for (size_t i = 0; i < in.size / 3; ++i) {
        double basis[kMaxShBases];
        sh_bases(degree, in[3 * i], in[3 * i + 1], in[3 * i + 2], basis);
        std::copy(basis, basis + num_bases, &out.span[num_bases * i]);
    }
    return out.object;
}

void bind_types(py::module_& m) {
    m.def("sh_bases", &sh_bases_of, "degree"_a, "directions"_a,
          "Returns the bases of spherical harmonics in unit directions: (D, (degree + 1)^2).");
    py::class_<BoundCamera>(m, "Camera", "A camera of any model, or a window of its image.")
        .def(py::init(&make_camera), py::kw_only(), "viewmat"_a, "K"_a, "width"_a, "height"_a,
             "near"_a, "model"_a = "pinhole", "distortion"_a = std::vector<double>{},
             "The model is pinhole; opencv, with the coefficients k1 to k6, p1 and p2; or fisheye, "
             "with k1 to k4.")
        .def("window", &window_of_camera, "x0"_a, "y0"_a, "x1"_a, "y1"_a,
             "Returns the camera for a part of its image: x in [x0, x1) and y in [y0, y1), px.")
        .def_property_readonly("position", &position_of, "The position in the world: (3,).")
        .def_property_readonly("K", &matrix_of, "The camera matrix, px: (3, 3).")
        .def_property_readonly("lens_range", &lens_range_of,
                               "The end of the valid range of a lens: the largest slope x / z of "
                               "opencv, the largest angle of fisheye in radians.")
        .def_property_readonly(
            "px2_per_steradian",
            [](const BoundCamera& bound) { return bound.camera.px2_per_steradian(); },
            "The density of pixels that selection assumes.")
        .def_property_readonly("width", &BoundCamera::width)
        .def_property_readonly("height", &BoundCamera::height);
    py::class_<BoundEyes>(m, "Eyes",
                          "A camera, or the two eyes of a stereo camera, which share a cut. Their "
                          "rotations are equal.")
        .def(py::init([](const BoundCamera& only) { return BoundEyes{only.camera}; }), "camera"_a)
        .def(py::init(&make_eyes), "left"_a, "right"_a);
    py::implicitly_convertible<BoundCamera, BoundEyes>();
    py::class_<SelectRule>(m, "Rule",
                           "The rule of a selection: tolerance, footprint, budget and fade.")
        .def(py::init(&make_rule), py::kw_only(), "tolerance_px2"_a, "budget"_a, "min_level"_a,
             "footprint"_a, "culls"_a, "fade"_a = 1.0, "frame"_a = 0)
        .def_readonly("tolerance_px2", &SelectRule::tolerance_px2);
    py::class_<Instances>(m, "Instances",
                          "The instances of a scene, on the host. It borrows the arrays.")
        .def(py::init<py::array, py::array, py::array, py::array, py::array, py::object>(),
             py::kw_only(), "bundle"_a, "positions"_a, "quaternions"_a, "scales"_a, "importance"_a,
             "factors"_a = py::none());
    py::class_<Rows>(m, "Rows", "The arrays of gaussians, on the host or on a CUDA device.")
        .def(py::init<py::object, py::object, py::object, py::object, py::object>(), "means"_a,
             "quats"_a, "scales"_a, "opacities"_a, "sh"_a)
        .def("__len__", &Rows::size)
        .def_property_readonly(
            "device", [](const Rows& rows) { return rows.device().number; },
            "The index of the CUDA device; -1 on the host.")
        .def_property_readonly("sh_degree", &Rows::sh_degree);
}

}  // namespace v3dg
