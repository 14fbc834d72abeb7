// Bindings of the fit of the groups of one level, and of the refinement of all levels
// together.

#include <algorithm>
#include <cfloat>
#include <memory>

#include "bindings/backend.h"
#include "bindings/operations.h"
#include "bindings/tables.h"
#include "fit_group/dssim.h"
#include "fit_group/ssim.h"

namespace v3dg {

namespace {

// The gaussians that groups are fitted to.
class BoundTarget {
  public:
    BoundTarget(const Rows& rows, float filter_px2, bool antialiased)
        : device_(rows.device()), size_(rows.size()), sh_degree_(rows.sh_degree()) {
        static_cast<void>(rows.read<float>());  // checks that the gaussians are float32
        target_ = backend_of(device_).make_target(rows, filter_px2, antialiased);
    }

    size_t size() const { return size_; }
    const backend::Target& handle() const { return *target_; }
    // Throws ValueError unless `gaussians` have the device and the SH degree of the
    // target.
    void check_alike(const Rows& gaussians) const {
        if (gaussians.device() != device_ || gaussians.sh_degree() != sh_degree_)
            throw py::value_error(
                "gaussians: expected the device and the SH degree of the target, got different "
                "ones");
    }

  private:
    Device device_;
    size_t size_;
    int sh_degree_;
    std::unique_ptr<backend::Target> target_;
};

// Returns the groups after checking their ranges. Target ranges must be within
// `num_targets` gaussians, and ranges within `num_rows`.
std::vector<FitGroup> groups_of(const py::array& target_range, const py::array& range,
                                const py::array& ball, const py::array& stream, size_t num_targets,
                                size_t num_rows) {
    const py::ssize_t num_groups = range.ndim() == 2 ? range.shape(0) : 0;
    const Span<const int64_t> targets =
        span_of<const int64_t>(target_range, "target_range", {num_groups, 2});
    const Span<const int64_t> own = span_of<const int64_t>(range, "range", {num_groups, 2});
    const Span<const float> balls = span_of<const float>(ball, "ball", {num_groups, 4});
    const Span<const int64_t> streams = span_of<const int64_t>(stream, "stream", {num_groups});
    std::vector<FitGroup> groups;
    for (py::ssize_t g = 0; g < num_groups; ++g) {
        const int64_t bounds[4] = {targets[2 * g], targets[2 * g + 1], own[2 * g], own[2 * g + 1]};
        if (bounds[0] < 0 || bounds[1] < bounds[0] ||
            bounds[1] > static_cast<int64_t>(num_targets) || bounds[2] < 0 ||
            bounds[3] < bounds[2] || bounds[3] > static_cast<int64_t>(num_rows))
            throw py::value_error(
                "target_range, range: expected [first, last) within the gaussians, got numbers "
                "outside for group " +
                std::to_string(g));
        FitGroup group{.target_first = static_cast<uint64_t>(bounds[0]),
                       .target_count = static_cast<uint64_t>(bounds[1] - bounds[0]),
                       .first = static_cast<uint64_t>(bounds[2]),
                       .count = static_cast<uint64_t>(bounds[3] - bounds[2]),
                       .center = {balls[4 * g], balls[4 * g + 1], balls[4 * g + 2]},
                       .radius = balls[4 * g + 3],
                       .stream = static_cast<uint64_t>(streams[g])};
        if (!(group.radius > 0))
            throw py::value_error("ball: expected a positive radius, got none for group " +
                                  std::to_string(g));
        groups.push_back(group);
    }
    return groups;
}

py::object fit_level_arrays(const FitConfig& config, const BoundTarget& target,
                            const py::array& target_range, const Rows& gaussians,
                            const py::array& range, const py::array& ball, const py::array& stream,
                            FitProgress& progress) {
    target.check_alike(gaussians);
    const std::vector<FitGroup> groups =
        groups_of(target_range, range, ball, stream, target.size(), gaussians.size());
    for (const FitGroup& group : groups) check_size(config, group);
    const GaussianRows<float> rows = gaussians.write();
    const NewArray<float> error({}, {static_cast<py::ssize_t>(groups.size()), 2});
    std::fill(error.span.begin(), error.span.end(), 0.0f);
    const Work work(gaussians.device());
    {
        const Unlocked unlocked;
        target.handle().fit_level(config, {groups.data(), groups.size()}, rows, error.span.data,
                                  progress, work);
    }
    return error.object;
}

// Pictures of cuts, and the arrays that they borrow from.
class BoundPictures {
  public:
    BoundPictures(const BoundTable& table, const Rows& asset,
                  const std::vector<BoundCamera>& cameras, uint64_t seed)
        : asset_(asset),
          cameras_(cameras_of(cameras)),
          pictures_(pictures_of_cuts(table.table(), on_host(asset),
                                     {cameras_.data(), cameras_.size()}, seed)) {}

    const CutPictures& pictures() const { return pictures_; }
    py::tuple view(uint64_t number, size_t cut) const {
        if (cut >= kViewSlots)
            refuse_value("cut", "expected a number below " + std::to_string(kViewSlots) + ", got " +
                                    std::to_string(cut));
        const AssetView view = asset_view(pictures_, number);
        const SelectRule rule = cuts_of_view(pictures_, view, number, cut + 1)[cut];
        const std::vector<int32_t> clusters = clusters_in_window(pictures_, view, rule);
        return py::make_tuple(
            BoundCamera{{}, view.window},
            py::array_t<int32_t>(static_cast<py::ssize_t>(clusters.size()), clusters.data()),
            view.samples);
    }
    // Throws ValueError unless the number of gaussians is that of the table.
    void check_all(const Rows& gaussians) const {
        if (gaussians.size() > UINT32_MAX)
            throw py::value_error("gaussians: expected fewer than 2^32, got " +
                                  std::to_string(gaussians.size()));
        const Span<const int64_t>& offset = pictures_.table.offset;
        const auto wanted = static_cast<size_t>(offset[offset.size - 1]);
        if (gaussians.size() != wanted)
            throw py::value_error("gaussians: expected " + std::to_string(wanted) +
                                  " as in the table, got " + std::to_string(gaussians.size()));
    }

  private:
    static std::vector<Camera> cameras_of(const std::vector<BoundCamera>& bound) {
        std::vector<Camera> cameras;
        for (const BoundCamera& camera : bound) cameras.push_back(camera.camera);
        return cameras;
    }
    static GaussianRows<const float> on_host(const Rows& asset) {
        if (asset.size() == 0) refuse_value("asset", "expected at least one gaussian, got none");
        check_is_on_host(
            asset.device(), "asset",
            "expected gaussians on the host, got gaussians on a device; copy them to the host");
        return asset.read<float>();
    }

    Rows asset_;
    std::vector<Camera> cameras_;
    CutPictures pictures_;
};

CutComparison make_comparison(int windows_per_step, int cuts_per_view, float window_means) {
    if (windows_per_step < 1 || windows_per_step > kMostWindows)
        refuse_value("windows_per_step", "expected 1 to " + std::to_string(kMostWindows) +
                                             ", got " + std::to_string(windows_per_step));
    if (cuts_per_view < 1 || cuts_per_view > int(kViewSlots))
        refuse_value("cuts_per_view", "expected 1 to " + std::to_string(kViewSlots) + ", got " +
                                          std::to_string(cuts_per_view));
    if (!(window_means >= 0 && window_means <= FLT_MAX))
        refuse_value("window_means",
                     "expected a finite number of at least 0, got " + std::to_string(window_means));
    return {windows_per_step, cuts_per_view, window_means};
}

void refine_cuts_arrays(const FitConfig& config, const CutComparison& comparison,
                        const BoundTarget& target, const Rows& gaussians, const py::array& radius,
                        const BoundPictures& pictures, FitProgress& progress) {
    target.check_alike(gaussians);
    const auto count = static_cast<py::ssize_t>(gaussians.size());
    const CutRows levels{gaussians.write(), span_of<const float>(radius, "radius", {count})};
    pictures.check_all(gaussians);
    for (const float radius_of_one : levels.radius)
        if (!(radius_of_one >= 0))
            throw py::value_error("radius: expected numbers of at least 0, got " +
                                  std::to_string(radius_of_one));
    const Work work(gaussians.device());
    const Unlocked unlocked;
    target.handle().refine_cuts(config, comparison, levels, pictures.pictures(), progress, work);
}

py::tuple weigh_cuts_arrays(const FitConfig& config, const Rows& gaussians,
                            const BoundPictures& pictures, FitProgress& progress) {
    pictures.check_all(gaussians);
    const GaussianRows<const float> rows = gaussians.read<float>();
    const auto count = static_cast<py::ssize_t>(gaussians.size());
    const NewArray<double> weight({}, {count});
    const NewArray<int32_t> num_looks({}, {count});
    std::fill(weight.span.begin(), weight.span.end(), 0.0);
    std::fill(num_looks.span.begin(), num_looks.span.end(), 0);
    const SeenOfGaussians seen{weight.span, num_looks.span};
    const py::tuple answer = py::make_tuple(weight.object, num_looks.object);
    const Work work(gaussians.device());
    {
        const Unlocked unlocked;
        work.backend().weigh_cuts(config, rows, pictures.pictures(), seen, progress, work);
    }
    return answer;
}

FitConfig make_config(int steps, int views_per_step, int num_views, int supersample, int image_size,
                      float px2_per_gaussian, float distance, float filter_px2, bool antialiased,
                      float loss_l1, float loss_dssim, float loss_alpha, float loss_cells,
                      float step_position, float step_log_scale, float step_quat, float step_logit,
                      float step_sh0, float step_sh_rest, bool position_in_world, float final_step,
                      float beta2, uint64_t seed) {
    return {.steps = steps,
            .views_per_step = views_per_step,
            .num_views = num_views,
            .supersample = supersample,
            .image_size = image_size,
            .px2_per_gaussian = px2_per_gaussian,
            .distance = distance,
            .filter_px2 = filter_px2,
            .antialiased = antialiased,
            .loss = {loss_l1, loss_dssim, loss_alpha, loss_cells},
            .step_position = step_position,
            .step_log_scale = step_log_scale,
            .step_quat = step_quat,
            .step_logit = step_logit,
            .step_sh0 = step_sh0,
            .step_sh_rest = step_sh_rest,
            .position_in_world = position_in_world,
            .final_step = final_step,
            .beta2 = beta2,
            .seed = seed};
}

py::tuple dssim_of(const py::array& picture, const py::array& target) {
    const Span<const float> p = span_of<const float>(picture, "picture", {-1, -1});
    const py::ssize_t height = picture.shape(0), width = picture.shape(1);
    const Span<const float> t = span_of<const float>(target, "target", {height, width});
    if (p.size == 0) throw py::value_error("picture: expected at least one pixel, got none");
    const NewArray<float> gradient({}, {height, width});
    std::fill(gradient.span.begin(), gradient.span.end(), 0.0f);
    SsimScratch scratch;
    const float value = dssim(p.data, t.data, static_cast<int>(width), static_cast<int>(height),
                              1.0f, gradient.span.data, scratch);
    return py::make_tuple(value, gradient.object);
}

template <class T>
double mean_ssim_of(const py::array& picture, const py::array& target) {
    const Span<const T> p = span_of<const T>(picture, "picture", {-1, -1, -1});
    const py::ssize_t height = picture.shape(0), width = picture.shape(1),
                      channels = picture.shape(2);
    const Span<const T> t = span_of<const T>(target, "target", {height, width, channels});
    if (std::min(height, width) <= kSsimRadius || channels == 0)
        throw py::value_error("picture: expected at least " + std::to_string(kSsimRadius + 1) +
                              " px on each side, got shape " + shape_text(picture));
    const auto side = [](py::ssize_t size) { return static_cast<size_t>(size); };
    const Unlocked unlocked;
    return mean_ssim<T>({p.data, t.data, side(height), side(width), side(channels)});
}

double ssim_of_pictures(const py::array& picture, const py::array& target) {
    const bool is_double = py::isinstance<py::array_t<double>>(picture);
    return is_double ? mean_ssim_of<double>(picture, target) : mean_ssim_of<float>(picture, target);
}

}  // namespace

void bind_fit_level(py::module_& m) {
    py::class_<FitConfig>(m, "FitConfig", "The settings of a fit. All of them are required.")
        .def(py::init(&make_config), py::kw_only(), "steps"_a, "views_per_step"_a, "num_views"_a,
             "supersample"_a, "image_size"_a, "px2_per_gaussian"_a, "distance"_a, "filter_px2"_a,
             "antialiased"_a, "loss_l1"_a, "loss_dssim"_a, "loss_alpha"_a, "loss_cells"_a,
             "step_position"_a, "step_log_scale"_a, "step_quat"_a, "step_logit"_a, "step_sh0"_a,
             "step_sh_rest"_a, "position_in_world"_a, "final_step"_a, "beta2"_a, "seed"_a);
    py::class_<FitProgress>(m, "FitProgress",
                            "The progress of a fit. Any thread may read it and cancel the fit.")
        .def(py::init<>())
        .def_property_readonly("groups_done",
                               [](const FitProgress& p) { return p.groups_done.load(); })
        .def_property_readonly("loss_sum", [](const FitProgress& p) { return p.loss_sum.load(); })
        .def("cancel", [](FitProgress& p) { p.cancel = true; });
    py::class_<BoundTarget>(m, "FitTarget", "The gaussians that groups are fitted to.")
        .def(py::init<const Rows&, float, bool>(), "gaussians"_a, "filter_px2"_a, "antialiased"_a);
    m.def("fit_level", &fit_level_arrays, "config"_a, "target"_a, "target_range"_a, "gaussians"_a,
          "range"_a, "ball"_a, "stream"_a, "progress"_a,
          "Fits groups of gaussians, in place, so that they look like groups of the target in "
          "their balls (G, 4). Returns the residuals in colour and alpha: (G, 2).");
    py::class_<BoundPictures>(
        m, "CutPictures",
        "Pictures of cuts of a bundle, from random directions or from given cameras. The asset "
        "is level 0.")
        .def(py::init<const BoundTable&, const Rows&, const std::vector<BoundCamera>&, uint64_t>(),
             py::kw_only(), "table"_a, "asset"_a, "cameras"_a, "seed"_a, py::keep_alive<1, 2>())
        .def("view", &BoundPictures::view, "number"_a, "cut"_a = 0,
             "Returns the camera of a view's window, the clusters of one cut in this window, and"
             " the samples per pixel side of the asset's picture.");
    py::class_<CutComparison>(m, "CutComparison",
                              "How a refinement compares cuts with the "
                              "asset.")
        .def(py::init(&make_comparison), py::kw_only(), "windows_per_step"_a, "cuts_per_view"_a,
             "window_means"_a);
    m.def("refine_cuts", &refine_cuts_arrays, py::kw_only(), "config"_a, "comparison"_a, "target"_a,
          "gaussians"_a, "radius"_a, "pictures"_a, "progress"_a,
          "Moves the gaussians of all levels, in place, so that pictures of cuts match pictures "
          "of the target.");
    m.def("weigh_cuts", &weigh_cuts_arrays, "config"_a, "gaussians"_a, "pictures"_a, "progress"_a,
          "Draws one picture of a cut per step. Returns for each gaussian the sum of its blend "
          "weights, as fractions of the pixels, and the number of cuts that contain it: (N,) and"
          " (N,).");
    m.def("dssim", &dssim_of, "picture"_a, "target"_a,
          "Returns the mean of 1 - SSIM of one channel, and its gradient with respect to the "
          "picture.");
    m.def("ssim", &ssim_of_pictures, "picture"_a, "target"_a,
          "Returns the mean SSIM of two pictures (H, W, C), both float32 or both float64. The "
          "border is mirrored.");
}

}  // namespace v3dg
