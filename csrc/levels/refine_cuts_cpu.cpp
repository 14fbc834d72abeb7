// Refinement on the CPU. Windows are drawn one after another, each on all threads.
// Views are planned in parallel, some windows ahead.

#include "levels/refine_cuts.h"

#include <algorithm>
#include <optional>
#include <vector>

#include "base/parallel_for.h"
#include "draw/model.h"
#include "draw/render.h"
#include "levels/refine_cuts_math.h"

namespace v3dg {

namespace {

constexpr size_t kGaussiansAtOnce = 256, kWindowsAtOnce = 32;
static_assert(kWindowsAtOnce <= kViewSlots,
              "windows that are planned together must use different slots");

// The planes of one picture: colour and alpha.
class Canvas {
  public:
    Picture<float> start(const Camera& camera) {
        width_ = static_cast<int>(camera.width);
        height_ = static_cast<int>(camera.height);
        values_.resize(4 * num_pixels());
        return {.window = {0, 0, width_, height_},
                .background = {},
                .color = color(),
                .alpha = alpha(),
                .depth = nullptr};
    }
    int width() const { return width_; }
    int height() const { return height_; }
    size_t num_pixels() const { return static_cast<size_t>(width_) * static_cast<size_t>(height_); }
    float* color() { return values_.data(); }
    float* alpha() { return values_.data() + 3 * num_pixels(); }
    ReadPlanes planes() const { return {values_.data(), values_.data() + 3 * num_pixels()}; }

  private:
    int width_ = 0, height_ = 0;
    std::vector<float> values_;
};

// A cell and the sum of its pixels' differences. Also adds up the sums of the window. A
// cell at the border of a picture may have fewer than kCellSide columns or rows.
struct Cell {
    size_t x0, y0, x1, y1;
    PixelValues sum;
    WindowSums of_window;

    Cell(const ReadPlanes& drawn, const ReadPlanes& wanted, size_t width, size_t height, size_t x,
         size_t y)
        : x0(x),
          y0(y),
          x1(std::min(x + kCellSide, width)),
          y1(std::min(y + kCellSide, height)),
          sum{},
          of_window{} {
        for (size_t row = y0; row < y1; ++row)
            for (size_t column = x0; column < x1; ++column) {
                const size_t i = row * width + column;
                const PixelValues pixel = difference(drawn.at(i), wanted.at(i));
                for (int k = 0; k < 4; ++k) sum.value[k] += pixel.value[k];
                of_window.add_pixel(drawn.at(i), wanted.at(i));
            }
    }
    static PixelValues difference(PixelValues pixel, const PixelValues& of_target) {
        for (int k = 0; k < 4; ++k) pixel.value[k] -= of_target.value[k];
        return pixel;
    }
};

// Replaces the picture by the gradients of the loss.
void put_slopes(const LossWeights& loss, float window_means, const Canvas& target,
                Canvas& picture) {
    const auto width = static_cast<size_t>(picture.width()),
               height = static_cast<size_t>(picture.height());
    const ReadPlanes drawn = picture.planes(), wanted = target.planes();
    std::vector<WindowSums> sums_of_row(num_cells(height), WindowSums{});
    const auto put_cell = [&](const Cell& cell) {
        WindowSums sums = cell.of_window;
        for (size_t y = cell.y0; y < cell.y1; ++y)
            for (size_t i = y * width + cell.x0; i < y * width + cell.x1; ++i) {
                PixelValues pixel = Cell::difference(drawn.at(i), wanted.at(i));
                sums.loss() += put_slopes(loss, cell.sum, pixel);
                for (size_t k = 0; k < 3; ++k) picture.color()[3 * i + k] = pixel.value[k];
                picture.alpha()[i] = pixel.value[3];
            }
        return sums;
    };
    parallel_for(sums_of_row.size(), 2, [&](size_t row) {
        for (size_t x = 0; x < width; x += kCellSide)
            sums_of_row[row].add(put_cell(Cell(drawn, wanted, width, height, x, row * kCellSide)));
    });
    WindowSums sums{};
    for (const WindowSums& of_row : sums_of_row) sums.add(of_row);
    const WindowSlopes slopes =
        slopes_of_window(loss, window_means, sums, static_cast<double>(width * height));
    parallel_for(height, 8, [&](size_t y) {
        for (size_t i = y * width; i < (y + 1) * width; ++i) {
            for (int k = 0; k < 3; ++k) {
                float& slope = picture.color()[3 * i + static_cast<size_t>(k)];
                slope = slopes.weighed(slope, k);
            }
            picture.alpha()[i] = slopes.weighed(picture.alpha()[i], 3);
        }
    });
}

// A planned window, with its camera and its clusters.
struct CutWindow {
    PlannedWindow plan;
    Camera camera;
    int samples;
    std::vector<int32_t> clusters;
};

// Plans windows, several of them at once on all threads.
class Windows {
  public:
    Windows(const CutPictures& pictures, size_t count, size_t cuts_per_view)
        : pictures_(pictures),
          count_(count),
          cuts_per_view_(cuts_per_view),
          views_(kViewSlots),
          windows_(kWindowsAtOnce) {}
    // Returns a window. The caller must request numbers in ascending order, starting
    // with 0.
    const CutWindow& operator[](size_t number) {
        if (number % kWindowsAtOnce == 0)
            parallel_for(std::min(kWindowsAtOnce, count_ - number), 1,
                         [&](size_t k) { windows_[k] = window(number + k); });
        return windows_[number % kWindowsAtOnce];
    }

  private:
    struct View {
        AssetView view;
        std::vector<SelectRule> cuts;
    };

    CutWindow window(size_t number) {
        const PlannedWindow plan = planned_window(number, cuts_per_view_);
        View& of_slot = views_[plan.slot];
        if (plan.is_new) {
            of_slot.view = asset_view(pictures_, plan.view);
            of_slot.cuts = cuts_of_view(pictures_, of_slot.view, plan.view, cuts_per_view_);
        }
        return {plan, of_slot.view.window, of_slot.view.samples,
                clusters_in_window(pictures_, of_slot.view, of_slot.cuts[plan.cut])};
    }

    const CutPictures& pictures_;
    const size_t count_, cuts_per_view_;
    std::vector<View> views_;
    std::vector<CutWindow> windows_;
};

// Pictures of the asset, one for the view in each slot.
class Targets {
  public:
    Targets(const FitTarget& target, uint64_t count)
        : target_(target), count_(count), pictures_(kViewSlots) {}

    // Returns the picture of the asset for a window. If the window's view is new, draws
    // the picture first.
    const Canvas& picture_of(const CutWindow& window) {
        Canvas& picture = pictures_[window.plan.slot];
        if (!window.plan.is_new) return picture;
        const Camera larger = window.camera.scaled(window.samples);
        const Draw<float> whole{.model = target_.model,
                                .first = 0,
                                .count = count_,
                                .view = view_of_world<float>(larger),
                                .appearance = {target_.filter_px2, target_.antialiased, false}};
        render<float>({whole}, larger.intrinsics<float>(), larger_.start(larger), false,
                      workspace_);
        picture.start(window.camera);
        average(larger_, window.samples, picture);
        return picture;
    }

  private:
    static void average(Canvas& larger, int samples, Canvas& picture) {
        const auto width = static_cast<size_t>(picture.width());
        parallel_for(static_cast<size_t>(picture.height()), 8, [&](size_t y) {
            for (size_t x = 0; x < width; ++x) {
                const size_t i = y * width + x;
                for (size_t k = 0; k < 3; ++k)
                    picture.color()[3 * i + k] =
                        box_average(larger.color(), width, 3, k, x, y, samples);
                picture.alpha()[i] = box_average(larger.alpha(), width, 1, 0, x, y, samples);
            }
        });
    }

    const FitTarget& target_;
    const uint64_t count_;
    Canvas larger_;
    Workspace<float> workspace_;
    std::vector<Canvas> pictures_;
};

// The gradients of all gaussians, summed over the windows of a step.
class GradientSum {
  public:
    GradientSum(size_t count, int sh_degree)
        : values_(num_values(sh_degree) * count, 0.0f),
          sum_(rows_in(values_.data(), count, sh_degree)),
          zeros_(num_values(sh_degree), 0.0f),
          zero_(rows_in(zeros_.data(), 1, sh_degree)),
          num_windows_(count, 0) {}

    void add(const std::vector<uint32_t>& index, const GaussianRows<const float>& gradient) {
        for (const uint32_t i : index)
            if (num_windows_[i]++ == 0) shown_.push_back(i);
        parallel_for(index.size(), kGaussiansAtOnce,
                     [&](size_t g) { add_gradient(gradient, g, sum_, index[g]); });
    }
    // Calls move(i, sum, num_windows) for each gaussian i that at least one window
    // showed. Then resets the sums.
    template <class Move>
    void move_shown(const Move& move) {
        parallel_for(shown_.size(), kGaussiansAtOnce, [&](size_t k) {
            const size_t i = shown_[k];
            move(i, GaussianRows<const float>(sum_), num_windows_[i]);
            copy_gaussian(zero_, 0, sum_, i);
            num_windows_[i] = 0;
        });
        shown_.clear();
    }

  private:
    std::vector<float> values_;
    GaussianRows<float> sum_;
    std::vector<float> zeros_;
    GaussianRows<const float> zero_;
    std::vector<uint8_t> num_windows_;  // at most kMostWindows
    std::vector<uint32_t> shown_;
};

// The gaussians of one window, their picture, and the backward pass of the picture.
class CutFrame {
  public:
    explicit CutFrame(const FitConfig& config)
        : appearance_{config.filter_px2, config.antialiased, false} {}

    // Returns rows for `count` gaussians. The caller must fill them before draw().
    const GaussianRows<float>& start(size_t count, int sh_degree) {
        values_.resize(num_values(sh_degree) * count);
        rows_ = rows_in(values_.data(), count, sh_degree);
        return rows_;
    }
    // Draws the picture. Before backward(), the caller must replace the picture by its
    // gradients.
    Canvas& draw(const Camera& camera) {
        model_.emplace(rows_);
        draw_ = {.model = &model_->planes(),
                 .first = 0,
                 .count = rows_.size,
                 .view = view_of_world<float>(camera),
                 .appearance = appearance_};
        intrinsics_ = camera.intrinsics<float>();
        picture_ = canvas_.start(camera);
        render<float>({draw_}, intrinsics_, picture_, true, workspace_);
        return canvas_;
    }
    GaussianRows<const float> backward() {
        gradients_.assign(values_.size(), 0.0f);
        const GaussianRows<float> gradient =
            rows_in(gradients_.data(), rows_.size, rows_.sh_degree);
        float d_background[3] = {};
        render_backward<float>(draw_, intrinsics_, picture_,
                               {canvas_.color(), canvas_.alpha(), nullptr}, workspace_, gradient,
                               {}, d_background);
        return gradient;
    }

  private:
    Appearance<float> appearance_;
    std::vector<float> values_, gradients_;
    GaussianRows<float> rows_{};
    std::optional<Model<float>> model_;
    Draw<float> draw_{};
    Intrinsics<float> intrinsics_{};
    Canvas canvas_;
    Picture<float> picture_{};
    Workspace<float> workspace_;
};

}  // namespace

void weigh_cuts(const FitConfig& config, const GaussianRows<const float>& rows,
                const CutPictures& pictures, const SeenOfGaussians& seen, FitProgress& progress) {
    const auto steps = static_cast<size_t>(config.steps);
    Windows windows(pictures, steps, 1);
    CutFrame frame(config);
    for (size_t i = 0; i < steps && !progress.cancel; ++i) {
        const CutWindow& window = windows[i];
        const std::vector<uint32_t> index = gaussians_of(pictures.table, window.clusters);
        const GaussianRows<float>& shown = frame.start(index.size(), 0);
        parallel_for(index.size(), kGaussiansAtOnce,
                     [&](size_t g) { copy_in_grey(rows, index[g], shown, g); });
        Canvas& picture = frame.draw(window.camera);
        const size_t count = picture.num_pixels();
        for (size_t i = 0; i < count; ++i)
            put_sum_slopes(picture.color() + 3 * i, picture.alpha()[i]);
        const GaussianRows<const float> gradient = frame.backward();
        for (size_t g = 0; g < index.size(); ++g) {
            seen.weight[index[g]] += blend_weight(gradient.sh[3 * g], count);
            ++seen.num_looks[index[g]];
        }
        ++progress.groups_done;
    }
}

void refine_cuts(const FitConfig& config, const CutComparison& comparison, const FitTarget& target,
                 uint64_t target_count, const CutRows& levels, const CutPictures& pictures,
                 FitProgress& progress) {
    const GaussianRows<float>& rows = levels.rows;
    const size_t num = num_values(rows.sh_degree);
    std::vector<float> moments(2 * num * rows.size, 0.0f);
    const Moments adam_moments{moments.data(), moments.data() + num * rows.size};
    const auto steps = static_cast<size_t>(config.steps),
               per_step = static_cast<size_t>(comparison.windows_per_step);
    Windows windows(pictures, steps * per_step, static_cast<size_t>(comparison.cuts_per_view));
    Targets targets(target, target_count);
    CutFrame frame(config);
    GradientSum sum(rows.size, rows.sh_degree);
    for (size_t i = 0; i < steps; ++i) {
        for (size_t number = i * per_step; number < (i + 1) * per_step; ++number) {
            if (progress.cancel) return;
            const CutWindow& window = windows[number];
            const Canvas& wanted = targets.picture_of(window);
            const std::vector<uint32_t> index = gaussians_of(pictures.table, window.clusters);
            const GaussianRows<float>& shown = frame.start(index.size(), rows.sh_degree);
            parallel_for(index.size(), kGaussiansAtOnce,
                         [&](size_t g) { copy_gaussian(rows, index[g], shown, g); });
            put_slopes(config.loss, comparison.window_means, wanted, frame.draw(window.camera));
            sum.add(index, frame.backward());
            ++progress.groups_done;
        }
        const FitStep step = fit_step(config, static_cast<int>(i));
        sum.move_shown([&](size_t g, const GaussianRows<const float>& gradient, int num_windows) {
            if (g < target_count || levels.radius[g] == 0) return;
            move_gaussian(rows, g, gradient, g, levels.radius[g],
                          step_of_windows(step, num_windows), config.beta2, adam_moments);
        });
    }
}

}  // namespace v3dg
