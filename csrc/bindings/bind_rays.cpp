// Bindings that cast the rays of a spherical sensor.

#include "bindings/operations.h"
#include "bindings/rays.h"

namespace v3dg {

namespace {

using Doubles = py::array_t<double, py::array::c_style>;
using Ints = py::array_t<int32_t, py::array::c_style>;

Span<const double> angles_of(const Doubles& angles, const char* name, double most) {
    const Span<const double> values = span_of<const double>(angles, name, {-1});
    bool ascends = values.size > 0 && values.size <= (1u << 20);
    for (size_t i = 0; ascends && i < values.size; ++i)
        ascends = std::abs(values[i]) <= most && (i == 0 || values[i] >= values[i - 1]);
    if (!ascends) refuse_value(name, "expected 1 to 1048576 ascending angles, got others");
    return values;
}

// Returns the places of angles in the picture: a permutation.
Span<const int32_t> places_of(const Ints& places, const char* name, size_t count) {
    const Span<const int32_t> values =
        span_of<const int32_t>(places, name, {static_cast<py::ssize_t>(count)});
    std::vector<bool> is_taken(count, false);
    for (const int32_t place : values) {
        const bool is_new = place >= 0 && static_cast<size_t>(place) < count && !is_taken[place];
        if (!is_new) refuse_value(name, "expected a permutation of the angles, got others");
        is_taken[place] = true;
    }
    return values;
}

std::shared_ptr<const RayGrid> grid_of(const Doubles& azimuth, const Doubles& elevation,
                                       const Ints& rows, const Ints& columns) {
    const Span<const double> of_columns = angles_of(azimuth, "azimuth", 2 * kPi);
    const Span<const double> of_rows = angles_of(elevation, "elevation", kPi / 2);
    return std::make_shared<RayGrid>(of_columns, of_rows, places_of(rows, "rows", of_rows.size),
                                     places_of(columns, "columns", of_columns.size));
}

// The planes of a cast; those that are not written are None.
struct BoundCast {
    py::object color = py::none(), alpha, range, intensity = py::none();
    py::object second_range = py::none(), second_intensity = py::none();
    std::vector<int64_t> gaussians;
};

// The least weight of a return, and the gap behind it.
using GivenRule = std::optional<std::array<float, 2>>;

// Makes the planes of a cast at `count` poses. With a rule of returns, they are those of
// the returns; otherwise colour and mean range.
RayPlanes make_planes(Device device, py::ssize_t count, const RayGrid& grid, const GivenRule& rule,
                      BoundCast& made) {
    const Shape shape{count, grid.num_rows(), grid.num_columns()};
    const auto plane = [&](py::object& object) {
        return new_elements<float>(device, shape, object);
    };
    RayPlanes planes{};
    planes.alpha = plane(made.alpha);
    if (rule) {
        planes.return_range[0] = plane(made.range);
        planes.return_intensity[0] = plane(made.intensity);
        planes.return_range[1] = plane(made.second_range);
        planes.return_intensity[1] = plane(made.second_intensity);
        planes.rule = {.least_weight = (*rule)[0], .gap = (*rule)[1]};
        return planes;
    }
    planes.range = plane(made.range);
    planes.color = new_elements<float>(device, {count, shape[1], shape[2], 3}, made.color);
    return planes;
}

// Casts the rays of sensors on one device. The models belong to the bundles of the
// scenes, in order; a scene may have fewer bundles.
class BoundRayFrame {
  public:
    explicit BoundRayFrame(int device) : device_{device} {
        const Work work(device_);
        frame_ = work.backend().make_ray_frame(work);
    }

    void set_models(const py::list& models) {
        std::vector<std::shared_ptr<const backend::Model>> handles;
        std::vector<size_t> num_gaussians;
        for (const py::handle& item : models) {
            const auto& model = held<BoundModel>(item, "models");
            check_device(model.device(), "models");
            handles.push_back(model.handle());
            num_gaussians.push_back(model.size());
        }
        const Work work(device_);
        frame_->set_models(std::move(handles), work);
        num_gaussians_ = std::move(num_gaussians);
    }

    BoundCast cast_scene(const BoundScene& scene, const RaySensor& sensor,
                         const py::object& viewmats, const SelectRule& rule,
                         const py::object& environments, const GivenRule& returns) const {
        check_device(scene.device(), "scene");
        if (rule.budget != kNoBudget)
            throw py::value_error("budget: expected none for rays, got one; leave it out");
        const std::shared_ptr<const SceneState> state = scene.state();
        const std::vector<size_t>& of_scene = state->num_gaussians;
        if (of_scene.size() > num_gaussians_.size() ||
            !std::equal(of_scene.begin(), of_scene.end(), num_gaussians_.begin()))
            throw py::value_error(
                "scene: expected a scene of the bundles of the models, got other bundles");
        const auto run = [&](const backend::CastInput& input, const Work& work) {
            return frame_->cast_scene(scene.handle(), *state, input, work);
        };
        return cast(sensor, viewmats, environments, state->environments->table(), rule, returns,
                    run);
    }

    BoundCast cast_model(const BoundModel& model, const RaySensor& sensor,
                         const py::object& viewmats, float filter_px2, bool antialiased,
                         const GivenRule& returns) const {
        check_device(model.device(), "model");
        if (model.has_codes())
            throw py::value_error(
                "model: expected the gaussians of an asset, got codes of a bundle");
        const Appearance<float> appearance{filter_px2, antialiased, false};
        const auto run = [&](const backend::CastInput& input, const Work& work) {
            return frame_->cast_model(*model.handle(), appearance, input, work);
        };
        return cast(sensor, viewmats, py::none(), {}, {}, returns, run);
    }

  private:
    // Makes the planes, and calls run(input, work) without the GIL.
    template <class Run>
    BoundCast cast(const RaySensor& sensor, const py::object& viewmats,
                   const py::object& environments, const EnvironmentTable& table,
                   const SelectRule& rule, const GivenRule& returns, const Run& run) const {
        check_device(device_of(viewmats, "viewmats"), "viewmats");
        const Reals matrices = reals_of(device_, viewmats, "viewmats", {-1, 4, 4});
        const py::ssize_t count = shape_of(viewmats, "viewmats")[0];
        const Wholes of_sensors = wholes_of(device_, environments, "environment", {count});
        check_environments(device_, of_sensors, static_cast<size_t>(count), table, "environment");
        const Work work(device_);
        BoundCast made;
        const backend::CastInput input{
            .sensor = sensor,
            .viewmats = matrices,
            .num_poses = static_cast<size_t>(count),
            .environments = of_sensors,
            .rule = rule,
            .planes = make_planes(device_, count, *sensor.grid, returns, made)};
        const Unlocked unlocked;
        made.gaussians = run(input, work);
        return made;
    }

    void check_device(Device device, const char* name) const {
        if (device != device_) refuse_value(name, "expected the frame's device, got another");
    }

    Device device_;
    std::vector<size_t> num_gaussians_;  // number of gaussians of each bundle
    std::unique_ptr<backend::RayFrame> frame_;
};

}  // namespace

void bind_rays(py::module_& m) {
    py::class_<RaySensor>(m, "RaySensor",
                          "A sensor without a pose: rays of ascending azimuths and elevations. "
                          "`rows` and `columns` are their places in the picture. The sensor has x "
                          "forward, y left and z up.")
        .def(py::init([](const Doubles& azimuth, const Doubles& elevation, const Ints& rows,
                         const Ints& columns, float near, float far, float spacing,
                         float min_transmittance) {
                 return RaySensor{.grid = grid_of(azimuth, elevation, rows, columns),
                                  .limits = {.nearest = near,
                                             .farthest = far,
                                             .spacing = spacing,
                                             .min_transmittance = min_transmittance}};
             }),
             py::kw_only(), "azimuth"_a, "elevation"_a, "rows"_a, "columns"_a, "near"_a, "far"_a,
             "spacing"_a, "min_transmittance"_a);
    py::class_<BoundCast>(m, "Cast",
                          "The results of casting rays at B poses: arrays of H rows and W columns, "
                          "or None.")
        .def_readonly("color", &BoundCast::color, "(B, H, W, 3), premultiplied.")
        .def_readonly("alpha", &BoundCast::alpha, "(B, H, W).")
        .def_readonly("range", &BoundCast::range,
                      "(B, H, W) of the first return; without returns, the mean distance.")
        .def_readonly("intensity", &BoundCast::intensity, "(B, H, W).")
        .def_readonly("second_range", &BoundCast::second_range, "(B, H, W).")
        .def_readonly("second_intensity", &BoundCast::second_intensity, "(B, H, W).")
        .def_readonly("gaussians", &BoundCast::gaussians, "Selected gaussians at each pose.");
    py::class_<BoundRayFrame>(m, "RayFrame", "Casts the rays of sensors on one device.")
        .def(py::init<int>(), "device"_a)
        .def("set_models", &BoundRayFrame::set_models, "models"_a)
        .def("cast_scene", &BoundRayFrame::cast_scene, "scene"_a, "sensor"_a, "viewmats"_a,
             "rule"_a, "environments"_a = py::none(), "returns"_a = py::none(),
             "Casts the rays of a sensor through the cut of a scene at each pose. `viewmats` are "
             "(B, 4, 4) from the world to the sensor. `environments` are (B,), or None for sensors "
             "that see all instances. With `returns`, the least weight of a return "
             "and the gap behind it, the result has returns, otherwise colour and range.")
        .def("cast_model", &BoundRayFrame::cast_model, "model"_a, "sensor"_a, "viewmats"_a,
             py::kw_only(), "filter_px2"_a, "antialiased"_a, "returns"_a = py::none(),
             "Casts the rays of a sensor through all gaussians of an asset, like cast_scene().");
}

}  // namespace v3dg
