// Bindings that cast the rays of a spherical sensor on the host.

#include "bindings/host_frame.h"
#include "bindings/operations.h"
#include "draw/cast_scene.h"

namespace v3dg {

namespace {

using Doubles = py::array_t<double, py::array::c_style>;

Span<const double> angles_of(const Doubles& angles, const char* name, double most) {
    const Span<const double> values = span_of<const double>(angles, name, {-1});
    bool ascends = values.size > 0 && values.size <= (1u << 20);
    for (size_t i = 0; ascends && i < values.size; ++i)
        ascends = std::abs(values[i]) <= most && (i == 0 || values[i] >= values[i - 1]);
    if (!ascends) refuse_value(name, "expected 1 to 1048576 ascending angles, got others");
    return values;
}

// A sensor at one pose.
struct BoundRaySensor {
    Camera camera;
    RayGrid grid;
    RayLimits limits;

    RaySensor sensor() const { return {.camera = camera, .grid = grid, .limits = limits}; }
};

// The planes of a cast; those that are not written are None.
struct BoundCast {
    py::object color = py::none(), alpha, range = py::none(), returns = py::none();
    int64_t gaussians = 0;
    float tolerance_px2 = 0;
    double select_ms = 0;
    RayCounts rays{};
};

using GivenRule = std::optional<std::array<float, 2>>;

// Makes the planes of a cast. With a rule of returns, they are the returns; otherwise
// colour and range.
RayPlanes make_planes(const RayGrid& grid, const GivenRule& rule, BoundCast& made) {
    const py::ssize_t height = grid.num_rows(), width = grid.num_columns();
    const NewArray<float> alpha(kHost, {height, width});
    made.alpha = alpha.object;
    RayPlanes planes{};
    planes.alpha = alpha.span.data;
    if (rule) {
        static_assert(sizeof(Return) == 3 * sizeof(float));
        const NewArray<float> returns(kHost, {height, width, kMostReturns, 3});
        made.returns = returns.object;
        planes.returns = reinterpret_cast<Return*>(returns.span.data);
        planes.rule = {.least_weight = (*rule)[0], .gap = (*rule)[1]};
        return planes;
    }
    const NewArray<float> color(kHost, {height, width, 3}), range(kHost, {height, width});
    made.color = color.object;
    made.range = range.object;
    planes.color = color.span.data;
    planes.range = range.span.data;
    return planes;
}

const host::HostModel& host_model(const py::handle& item) {
    const auto& model = held<BoundModel>(item, "models");
    check_is_on_host(model.device(), "models", "expected models on the CPU, got one on a device");
    return static_cast<const host::HostModel&>(*model.handle());
}

BoundCast cast_scene(const BoundScene& scene, const py::list& models, const BoundRaySensor& sensor,
                     const SelectRule& rule, const GivenRule& returns) {
    check_is_on_host(scene.device(), "scene", "expected a scene on the CPU, got one on a device");
    if (rule.budget != kNoBudget)
        throw py::value_error("budget: expected none for rays, got one; leave it out");
    const std::shared_ptr<const SceneState> state = scene.state();
    if (models.size() != state->tables.size())
        throw py::value_error("models: expected one for each bundle of the scene, got " +
                              std::to_string(models.size()));
    std::vector<SceneModel> drawn;
    for (size_t b = 0; b < models.size(); ++b) {
        const host::HostModel& model = host_model(models[b]);
        if (model.size() != state->num_gaussians[b])
            throw py::value_error(
                "models: expected the gaussians of the scene's bundles, got "
                "others");
        drawn.push_back({.planes = model.planes(),
                         .appearance = state->bundle(b).appearance(),
                         .palette = {},
                         .codes = model.codes()});
    }
    BoundCast made;
    const RayPlanes planes = make_planes(sensor.grid, returns, made);
    CastCounts counts;
    {
        const Unlocked unlocked;
        counts = cpu::cast_scene({.tables = {state->tables.data(), state->tables.size()},
                                  .models = {drawn.data(), drawn.size()},
                                  .instances = state->instances},
                                 sensor.sensor(), rule, planes);
    }
    made.gaussians = counts.gaussians;
    made.tolerance_px2 = counts.tolerance_px2;
    made.select_ms = 1e3 * counts.select_seconds;
    made.rays = counts.rays;
    return made;
}

BoundCast cast_model(const BoundModel& bound, const BoundRaySensor& sensor, float filter_px2,
                     bool antialiased, const GivenRule& returns) {
    const host::HostModel& model = host_model(py::cast(bound, py::return_value_policy::reference));
    if (model.planes() == nullptr)
        throw py::value_error("model: expected the gaussians of an asset, got codes of a bundle");
    BoundCast made;
    const RayPlanes planes = make_planes(sensor.grid, returns, made);
    {
        const Unlocked unlocked;
        const Draw<float> draw{.model = model.planes(),
                               .first = 0,
                               .count = model.size(),
                               .view = view_of_world<float>(sensor.camera),
                               .appearance = {filter_px2, antialiased, false}};
        made.rays = cpu::cast_rays({draw}, sensor.grid, sensor.limits, planes);
    }
    made.gaussians = static_cast<int64_t>(model.size());
    return made;
}

}  // namespace

void bind_rays(py::module_& m) {
    py::class_<BoundRaySensor>(m, "RaySensor",
                               "A sensor at one pose: rays of ascending azimuths and elevations. "
                               "The camera has x forward, y left and z up.")
        .def(
            py::init([](const BoundCamera& camera, const Doubles& azimuth, const Doubles& elevation,
                        float far, float spacing, float min_transmittance) {
                const Span<const double> columns = angles_of(azimuth, "azimuth", 2 * kPi);
                const Span<const double> rows = angles_of(elevation, "elevation", kPi / 2);
                return BoundRaySensor{
                    .camera = camera.camera,
                    .grid = RayGrid(columns, rows),
                    .limits = {.nearest = static_cast<float>(camera.camera.near_depth),
                               .farthest = far,
                               .spacing = spacing,
                               .min_transmittance = min_transmittance}};
            }),
            "camera"_a, "azimuth"_a, "elevation"_a, py::kw_only(), "far"_a, "spacing"_a,
            "min_transmittance"_a);
    py::class_<BoundCast>(m, "Cast", "The results of casting rays: arrays of H rows and W columns.")
        .def_readonly("color", &BoundCast::color, "(H, W, 3), premultiplied, or None.")
        .def_readonly("alpha", &BoundCast::alpha, "(H, W).")
        .def_readonly("range", &BoundCast::range, "(H, W) mean distance, or None.")
        .def_readonly("returns", &BoundCast::returns,
                      "(H, W, 2, 3) range, weight and intensity of each return, or None.")
        .def_readonly("gaussians", &BoundCast::gaussians)
        .def_readonly("tolerance_px2", &BoundCast::tolerance_px2)
        .def_readonly("select_ms", &BoundCast::select_ms)
        .def_property_readonly("records", [](const BoundCast& c) { return c.rays.records; })
        .def_property_readonly("entries", [](const BoundCast& c) { return c.rays.entries; })
        .def_property_readonly("project_ms",
                               [](const BoundCast& c) { return 1e3 * c.rays.project_seconds; })
        .def_property_readonly("bin_ms",
                               [](const BoundCast& c) { return 1e3 * c.rays.bin_seconds; })
        .def_property_readonly("blend_ms",
                               [](const BoundCast& c) { return 1e3 * c.rays.blend_seconds; });
    m.def("cast_scene", &cast_scene, "scene"_a, "models"_a, "sensor"_a, "rule"_a,
          "returns"_a = py::none(),
          "Casts the rays of a sensor through the cut of a scene. With `returns`, the least weight "
          "of a return and the gap behind it, the result has returns, otherwise colour and range.");
    m.def("cast_model", &cast_model, "model"_a, "sensor"_a, py::kw_only(), "filter_px2"_a,
          "antialiased"_a, "returns"_a = py::none(),
          "Casts the rays of a sensor through all gaussians of an asset, like cast_scene().");
}

}  // namespace v3dg
