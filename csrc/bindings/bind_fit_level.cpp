#include <memory>

#include "bindings/args.h"
#include "bindings/device_args.h"
#include "bindings/render_args.h"
#include "pipeline/fit_level.h"
#include "pipeline/fit_level_cuda.h"
#include "pipeline/model.h"

namespace v3dg {

using namespace py::literals;

namespace {

// The groups that index `num_targets` and `num_rows` gaussians.
std::vector<FitGroup> groups_of(const py::array& target_range, const py::array& range, const py::array& ball,
                                const py::array& stream, py::ssize_t num_targets, py::ssize_t num_rows) {
    const py::ssize_t num_groups = range.ndim() == 2 ? range.shape(0) : 0;
    const Span<const int64_t> targets = span_of<const int64_t>(target_range, "target_range", {num_groups, 2});
    const Span<const int64_t> own = span_of<const int64_t>(range, "range", {num_groups, 2});
    const Span<const float> balls = span_of<const float>(ball, "ball", {num_groups, 4});
    const Span<const int64_t> streams = span_of<const int64_t>(stream, "stream", {num_groups});
    std::vector<FitGroup> groups;
    for (py::ssize_t g = 0; g < num_groups; ++g) {
        const int64_t bounds[4] = {targets[2 * g], targets[2 * g + 1], own[2 * g], own[2 * g + 1]};
        if (bounds[0] < 0 || bounds[1] < bounds[0] || bounds[1] > num_targets || bounds[2] < 0 ||
            bounds[3] < bounds[2] || bounds[3] > num_rows)
            throw py::value_error("range: expected [first, last) within the gaussians, group " +
                                  std::to_string(g) + " is not");
        FitGroup group{static_cast<uint64_t>(bounds[0]),
                       static_cast<uint64_t>(bounds[1] - bounds[0]),
                       static_cast<uint64_t>(bounds[2]),
                       static_cast<uint64_t>(bounds[3] - bounds[2]),
                       {balls[4 * g], balls[4 * g + 1], balls[4 * g + 2]},
                       balls[4 * g + 3],
                       static_cast<uint64_t>(streams[g])};
        if (!(group.radius > 0))
            throw py::value_error("ball: expected a positive radius, group " + std::to_string(g) +
                                  " has none");
        groups.push_back(group);
    }
    return groups;
}

float* errors_of(py::array& error, size_t num_groups) {
    return span_of<float>(error, "error", {static_cast<py::ssize_t>(num_groups), 2}).data;
}

void fit_level_arrays(const FitConfig& config, const std::shared_ptr<Model<float>>& target,
                      float target_filter_px2, bool target_compensate, const py::array& target_range,
                      const py::array& range, const py::array& ball, const py::array& stream,
                      py::array& means, py::array& quats, py::array& scales, py::array& opacities,
                      py::array& sh, py::array& error, FitProgress& progress) {
    const py::ssize_t n = opacities.ndim() == 1 ? opacities.shape(0) : 0;
    const int degree = target->planes().sh_degree;
    const std::vector<FitGroup> groups =
        groups_of(target_range, range, ball, stream, static_cast<py::ssize_t>(target->size()), n);
    const GaussianRows<float> rows{span_of<float>(means, "means", {n, 3}).data,
                                   span_of<float>(quats, "quats", {n, 4}).data,
                                   span_of<float>(scales, "scales", {n, 3}).data,
                                   span_of<float>(opacities, "opacities", {n}).data,
                                   span_of<float>(sh, "sh", {n, num_sh_bases(degree), 3}).data,
                                   static_cast<size_t>(n),
                                   degree};
    float* errors = errors_of(error, groups.size());
    py::gil_scoped_release unlocked;
    fit_level(config, {groups.data(), groups.size()},
              {&target->planes(), target_filter_px2, target_compensate}, rows, errors, progress);
}

}  // namespace

void bind_fit_level(py::module_& m) {
    py::class_<LossWeights>(m, "LossWeights")
        .def(py::init([](float l1, float dssim, float alpha) { return LossWeights{l1, dssim, alpha}; }),
             "l1"_a, "dssim"_a, "alpha"_a);
    py::class_<FitConfig>(m, "FitConfig")
        .def(py::init<>([] { return FitConfig{}; }))
        .def_readwrite("steps", &FitConfig::steps)
        .def_readwrite("views_per_step", &FitConfig::views_per_step)
        .def_readwrite("num_views", &FitConfig::num_views)
        .def_readwrite("supersample", &FitConfig::supersample)
        .def_readwrite("image_size", &FitConfig::image_size)
        .def_readwrite("px2_per_gaussian", &FitConfig::px2_per_gaussian)
        .def_readwrite("distance", &FitConfig::distance)
        .def_readwrite("filter_px2", &FitConfig::filter_px2)
        .def_readwrite("compensate", &FitConfig::compensate)
        .def_readwrite("loss", &FitConfig::loss)
        .def_readwrite("step_position", &FitConfig::step_position)
        .def_readwrite("step_log_scale", &FitConfig::step_log_scale)
        .def_readwrite("step_quat", &FitConfig::step_quat)
        .def_readwrite("step_logit", &FitConfig::step_logit)
        .def_readwrite("step_sh0", &FitConfig::step_sh0)
        .def_readwrite("step_sh_rest", &FitConfig::step_sh_rest)
        .def_readwrite("position_in_world", &FitConfig::position_in_world)
        .def_readwrite("final_step", &FitConfig::final_step)
        .def_readwrite("seed", &FitConfig::seed);
    py::class_<FitProgress>(m, "FitProgress")
        .def(py::init<>())
        .def_property_readonly("groups_done", [](const FitProgress& p) { return p.groups_done.load(); })
        .def_property_readonly("loss_sum", [](const FitProgress& p) { return p.loss_sum.load(); })
        .def("cancel", [](FitProgress& p) { p.cancel = true; });
    m.def("fit_level", &fit_level_arrays, "config"_a, "target"_a, "target_filter_px2"_a,
          "target_compensate"_a, "target_range"_a, "range"_a, "ball"_a, "stream"_a, "means"_a, "quats"_a,
          "scales"_a, "opacities"_a, "sh"_a, "error"_a, "progress"_a);
    if constexpr (V3DG_WITH_CUDA) {
        m.def(
            "fit_level_cuda",
            [](const FitConfig& config, const py::object& target_means, const py::object& target_quats,
               const py::object& target_scales, const py::object& target_opacities,
               const py::object& target_sh, float target_filter_px2, bool target_compensate,
               const py::array& target_range, const py::array& range, const py::array& ball,
               const py::array& stream, const py::object& means, const py::object& quats,
               const py::object& scales, const py::object& opacities, const py::object& sh, py::array& error,
               FitProgress& progress, uintptr_t cuda_stream) {
                const Span<const float> target_opacity =
                    device_span_of<const float>(target_opacities, "target_opacities", {-1});
                const Span<float> opacity = device_span_of<float>(opacities, "opacities", {-1});
                const auto num_targets = static_cast<py::ssize_t>(target_opacity.size);
                const auto n = static_cast<py::ssize_t>(opacity.size);
                const Span<const float> target_coefficients =
                    device_span_of<const float>(target_sh, "target_sh", {num_targets, -1, 3});
                const py::ssize_t bases =
                    num_targets > 0 ? static_cast<py::ssize_t>(target_coefficients.size) / num_targets / 3
                                    : 1;
                const int degree = degree_of_bases(bases, "(N, " + std::to_string(bases) + ", 3)");
                const cuda::DeviceFitTarget target{
                    {device_span_of<const float>(target_means, "target_means", {num_targets, 3}).data,
                     device_span_of<const float>(target_quats, "target_quats", {num_targets, 4}).data,
                     device_span_of<const float>(target_scales, "target_scales", {num_targets, 3}).data,
                     target_opacity.data, target_coefficients.data, target_opacity.size, degree},
                    target_filter_px2,
                    target_compensate};
                const GaussianRows<float> rows{device_span_of<float>(means, "means", {n, 3}).data,
                                               device_span_of<float>(quats, "quats", {n, 4}).data,
                                               device_span_of<float>(scales, "scales", {n, 3}).data,
                                               opacity.data,
                                               device_span_of<float>(sh, "sh", {n, bases, 3}).data,
                                               static_cast<size_t>(n),
                                               degree};
                const std::vector<FitGroup> groups =
                    groups_of(target_range, range, ball, stream, num_targets, n);
                float* errors = errors_of(error, groups.size());
                py::gil_scoped_release unlocked;
                cuda::fit_level(config, {groups.data(), groups.size()}, target, rows, errors, progress,
                                reinterpret_cast<cuda::Stream>(cuda_stream));
            },
            "config"_a, "target_means"_a, "target_quats"_a, "target_scales"_a, "target_opacities"_a,
            "target_sh"_a, "target_filter_px2"_a, "target_compensate"_a, "target_range"_a, "range"_a,
            "ball"_a, "stream"_a, "means"_a, "quats"_a, "scales"_a, "opacities"_a, "sh"_a, "error"_a,
            "progress"_a, "cuda_stream"_a,
            "The same on a device, where all gaussians are; the other arrays are on the host.");
    }
}

}  // namespace v3dg
