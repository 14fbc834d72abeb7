// Views of gaussians without levels on the host, in float32 or float64.

#include <algorithm>

#include "base/parallel_for.h"
#include "bindings/host_frame.h"
#include "bindings/views.h"
#include "draw/model.h"

namespace v3dg::host {

namespace {

template <class T>
class HostViewsTape final : public ViewsTape {
  public:
    HostViewsTape(const std::vector<GaussianRows<const T>>& gaussians,
                  const std::vector<Camera>& cameras, const ViewsLook& look)
        : cameras_(cameras), look_(look), workspaces_(cameras.size()) {
        for (const GaussianRows<const T>& rows : gaussians)
            models_.push_back(std::make_unique<::v3dg::Model<T>>(rows));
    }

    // Each thread draws one view at a time. When fewer views than threads are left, all
    // threads draw each of them together.
    void draw(T* color, T* alpha, T* depth, bool keeps_tape) {
        const size_t num_views = cameras_.size();
        const size_t first_left_over = num_views - num_views % most_threads();
        std::vector<Workspace<T>> of_thread(keeps_tape ? 0 : most_threads());
        const auto draw_view = [&](size_t view) {
            const size_t skipped = view * num_pixels();
            Picture<T> picture = picture_of(view);
            picture.color = color + 3 * skipped;
            picture.alpha = alpha + skipped;
            if (depth != nullptr) picture.depth = depth + skipped;
            Workspace<T>& workspace = keeps_tape ? workspaces_[view] : of_thread[thread_index()];
            render<T>({draw_of(view)}, cameras_[view].template intrinsics<T>(), picture, keeps_tape,
                      workspace);
        };
        parallel_for(first_left_over, 1, draw_view);
        for (size_t view = first_left_over; view < num_views; ++view) draw_view(view);
    }

    Gradients backward(const py::object& d_color, const py::object& d_alpha,
                       const py::object& d_depth, const ViewsWanted& wanted) override {
        const auto num_views = static_cast<py::ssize_t>(cameras_.size());
        const ViewsGradientPlanes<T> planes(kHost, {num_views, height(), width()}, d_color, d_alpha,
                                            d_depth);
        Gradients made;
        const NewViewsGradients<T> sums(models_[0]->size(), models_[0]->planes().sh_degree,
                                        num_views, wanted, made, zeros<T>);
        const Unlocked unlocked;
        add_views(sums, wanted, planes);
        return made;
    }

  private:
    // Rows for the gradients of one view, before they are added to the sums over views.
    class Scratch {
      public:
        GaussianRows<T> cleared(const GaussianRows<T>& sums, const ViewsWanted& wanted) {
            const size_t n = sums.size;
            const size_t num_sh = wanted.sh_for_each_view ? 0 : sums.num_sh() * n;
            const size_t num_opacities = wanted.opacities_for_each_view ? 0 : n;
            values_.assign(10 * n + num_opacities + num_sh, T(0));
            GaussianRows<T> rows = sums;
            rows.means = values_.data();
            rows.quats = rows.means + 3 * n;
            rows.scales = rows.quats + 4 * n;
            if (num_opacities > 0) rows.opacities = rows.scales + 3 * n;
            if (num_sh > 0) rows.sh = rows.scales + 3 * n + num_opacities;
            return rows;
        }
        void add_to(const GaussianRows<T>& sums, const ViewsWanted& wanted) const {
            const size_t n = sums.size;
            const T* from = values_.data();
            const auto add = [&](size_t width, T* to) {
                for (size_t i = 0; i < width * n; ++i) to[i] += from[i];
                from += width * n;
            };
            add(3, sums.means);
            add(4, sums.quats);
            add(3, sums.scales);
            if (!wanted.opacities_for_each_view) add(1, sums.opacities);
            if (!wanted.sh_for_each_view) add(sums.num_sh(), sums.sh);
        }

      private:
        std::vector<T> values_;
    };

    // Adds the gradients of all views in their order. If there are few gaussians, each
    // thread computes one view, whose rows are then added. When fewer views than
    // threads are left, all threads compute each of them together.
    void add_views(const NewViewsGradients<T>& sums, const ViewsWanted& wanted,
                   const ViewsGradientPlanes<T>& planes) {
        constexpr size_t kMostScratchRows = size_t(1) << 21;
        const size_t num_views = cameras_.size();
        const size_t num_threads = most_threads();
        const bool spreads = num_threads > 1 && sums.rows.size * num_threads <= kMostScratchRows;
        const size_t first_left_over = spreads ? num_views - num_views % num_threads : 0;
        std::vector<Scratch> scratch(spreads ? num_threads : 0);
        for (size_t first = 0; first < first_left_over; first += num_threads) {
            parallel_for(num_threads, 1, [&](size_t k) {
                add_view(first + k, scratch[k].cleared(sums.rows, wanted), sums, wanted, planes);
            });
            for (const Scratch& of_view : scratch) of_view.add_to(sums.rows, wanted);
        }
        for (size_t view = first_left_over; view < num_views; ++view)
            add_view(view, sums.rows, sums, wanted, planes);
    }

    // Adds the gradients of a view to `rows`, and sets the gradients that only belong
    // to this view.
    void add_view(size_t view, GaussianRows<T> rows, const NewViewsGradients<T>& sums,
                  const ViewsWanted& wanted, const ViewsGradientPlanes<T>& planes) const {
        const size_t skipped = view * rows.size;
        if (wanted.opacities_for_each_view) rows.opacities += skipped;
        if (wanted.sh_for_each_view) rows.sh += skipped * rows.num_sh();
        CenterGradients<T> centers = sums.centers;
        if (centers.sum != nullptr) centers.sum += 2 * skipped;
        if (centers.size != nullptr) centers.size += skipped;
        PoseSums<double> pose{};
        const ViewSums view_sums{.pose = sums.poses != nullptr ? &pose : nullptr};
        const Draw<T> draw = draw_of(view);
        render_backward<T>(draw, cameras_[view].template intrinsics<T>(), picture_of(view),
                           planes.of_view(view), workspaces_[view], rows, centers,
                           sums.background + 3 * view, &view_sums);
        if (sums.poses != nullptr) set_pose(pose, draw.view, sums.poses + 12 * view);
    }

    py::ssize_t height() const { return static_cast<py::ssize_t>(cameras_[0].height); }
    py::ssize_t width() const { return static_cast<py::ssize_t>(cameras_[0].width); }
    size_t num_pixels() const { return static_cast<size_t>(height() * width()); }

    Draw<T> draw_of(size_t view) const {
        const ::v3dg::Model<T>& model = *models_[models_.size() > 1 ? view : 0];
        return {.model = &model.planes(),
                .first = 0,
                .count = model.size(),
                .view = view_of_world<T>(cameras_[view]),
                .appearance = {T(look_.filter_px2), look_.antialiased, false}};
    }

    // Returns a picture whose memory is not set.
    Picture<T> picture_of(size_t view) const {
        const std::array<double, 3> background = look_.of_view(view).background;
        return {.window = {0, 0, static_cast<int>(width()), static_cast<int>(height())},
                .background = {T(background[0]), T(background[1]), T(background[2])},
                .color = nullptr,
                .alpha = nullptr,
                .depth = nullptr};
    }

    static void set_pose(const PoseSums<double>& sums, const ModelView<T>& view, T* out) {
        double d_pose[12];
        pose_gradient(sums, view, d_pose);
        for (int k = 0; k < 12; ++k) out[k] = static_cast<T>(d_pose[k]);
    }

    std::vector<std::unique_ptr<::v3dg::Model<T>>> models_;
    std::vector<Camera> cameras_;
    ViewsLook look_;
    std::vector<Workspace<T>> workspaces_;
};

template <class T>
RasterizedViews rasterize_views_as(const std::vector<Rows>& gaussians, const BoundCameras& cameras,
                                   const ViewsLook& look, bool with_depth, bool keep_tape) {
    const NewViews<T> made(kHost, cameras, with_depth);
    std::vector<GaussianRows<const T>> rows;
    for (const Rows& of_view : gaussians) rows.push_back(look.of_view(0).read<T>(of_view));
    std::unique_ptr<HostViewsTape<T>> tape;
    {
        const Unlocked unlocked;
        tape = std::make_unique<HostViewsTape<T>>(rows, cameras.on_host(), look);
        tape->draw(made.color_plane, made.alpha_plane, made.depth_plane, keep_tape);
    }
    return {.color = made.color,
            .alpha = made.alpha,
            .depth = made.depth,
            .tape = keep_tape ? std::move(tape) : nullptr};
}

}  // namespace

RasterizedViews rasterize_views(const std::vector<Rows>& gaussians, const BoundCameras& cameras,
                                const ViewsLook& look, bool with_depth, bool keep_tape) {
    return gaussians[0].is_double()
               ? rasterize_views_as<double>(gaussians, cameras, look, with_depth, keep_tape)
               : rasterize_views_as<float>(gaussians, cameras, look, with_depth, keep_tape);
}

}  // namespace v3dg::host
