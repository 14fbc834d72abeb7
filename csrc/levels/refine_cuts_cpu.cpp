// One picture is drawn at a time, on all threads; views are made some ahead.

#include "levels/refine_cuts.h"

#include <algorithm>
#include <numeric>
#include <optional>
#include <vector>

#include "base/parallel_for.h"
#include "draw/model.h"
#include "draw/render.h"
#include "levels/refine_cuts_math.h"

namespace v3dg {

namespace {

constexpr size_t kGaussiansAtOnce = 256, kViewsAtOnce = 32;

// The memory of one picture: colour and alpha.
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

  private:
    int width_ = 0, height_ = 0;
    std::vector<float> values_;
};

// Puts the slopes of the loss in place of the picture.
void compare(const FitConfig& config, int samples, Canvas& picture, Canvas& target) {
    const auto width = static_cast<size_t>(picture.width()),
               height = static_cast<size_t>(picture.height());
    std::vector<double> loss_of_row(height, 0.0);
    parallel_for(height, 8, [&](size_t y) {
        for (size_t x = 0; x < width; ++x) {
            float* color = picture.color() + 3 * (y * width + x);
            float& alpha = picture.alpha()[y * width + x];
            for (int k = 0; k < 3; ++k)
                color[k] -= box_average(target.color(), width, 3, k, x, y, samples);
            alpha -= box_average(target.alpha(), width, 1, 0, x, y, samples);
            loss_of_row[y] += loss_of_pixel(config.loss, color, alpha);
        }
    });
    const float weight =
        weight_of_picture(std::accumulate(loss_of_row.begin(), loss_of_row.end(), 0.0),
                          static_cast<double>(width * height));
    for (size_t i = 0; i < width * height; ++i)
        put_slopes(config.loss, weight, picture.color() + 3 * i, picture.alpha()[i]);
}

// Makes the views of pictures, some ahead.
class Views {
  public:
    Views(const CutPictures& pictures, size_t count)
        : pictures_(pictures), count_(count), views_(kViewsAtOnce) {}
    // Returns a view. Numbers must be asked for in ascending order from 0.
    const CutView& operator[](size_t number) {
        if (number % kViewsAtOnce == 0)
            parallel_for(std::min(kViewsAtOnce, count_ - number), 1,
                         [&](size_t k) { views_[k] = cut_view(pictures_, number + k); });
        return views_[number % kViewsAtOnce];
    }

  private:
    const CutPictures& pictures_;
    const size_t count_;
    std::vector<CutView> views_;
};

// The gaussians of one view, their picture, and its backward pass.
class CutFrame {
  public:
    explicit CutFrame(const FitConfig& config)
        : appearance_{config.filter_px2, config.antialiased, false} {}

    // Returns the rows of `count` gaussians, which the caller writes before they are drawn.
    const GaussianRows<float>& start(size_t count, int sh_degree) {
        values_.resize(num_values(sh_degree) * count);
        rows_ = rows_in(values_.data(), count, sh_degree);
        return rows_;
    }
    // Draws the picture. Before backward(), the caller puts its slopes in its place.
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
    Views views(pictures, steps);
    CutFrame frame(config);
    for (size_t i = 0; i < steps && !progress.cancel; ++i) {
        const CutView& view = views[i];
        const std::vector<uint32_t> index = gaussians_of(pictures.table, view);
        const GaussianRows<float>& shown = frame.start(index.size(), 0);
        parallel_for(index.size(), kGaussiansAtOnce,
                     [&](size_t g) { copy_in_grey(rows, index[g], shown, g); });
        Canvas& picture = frame.draw(view.camera);
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

void refine_cuts(const FitConfig& config, const FitTarget& target, uint64_t target_count,
                 const CutRows& levels, const CutPictures& pictures, FitProgress& progress) {
    const GaussianRows<float>& rows = levels.rows;
    const size_t num = num_values(rows.sh_degree);
    std::vector<float> moments(2 * num * rows.size, 0.0f);
    const Moments adam_moments{moments.data(), moments.data() + num * rows.size};
    Workspace<float> of_target;
    Canvas wanted;
    const auto steps = static_cast<size_t>(config.steps);
    Views views(pictures, steps);
    CutFrame frame(config);
    for (size_t i = 0; i < steps && !progress.cancel; ++i) {
        const CutView& view = views[i];
        const Camera larger = enlarged(view.camera, view.samples);
        const Draw<float> whole{.model = target.model,
                                .first = 0,
                                .count = target_count,
                                .view = view_of_world<float>(larger),
                                .appearance = {target.filter_px2, target.antialiased, false}};
        render<float>({whole}, larger.intrinsics<float>(), wanted.start(larger), false, of_target);

        const std::vector<uint32_t> index = gaussians_of(pictures.table, view);
        const GaussianRows<float>& shown = frame.start(index.size(), rows.sh_degree);
        parallel_for(index.size(), kGaussiansAtOnce,
                     [&](size_t g) { copy_gaussian(rows, index[g], shown, g); });
        compare(config, view.samples, frame.draw(view.camera), wanted);
        const GaussianRows<const float> gradient = frame.backward();

        const FitStep step = fit_step(config, static_cast<int>(i));
        parallel_for(index.size(), kGaussiansAtOnce, [&](size_t g) {
            if (index[g] < target_count) return;
            move_gaussian(rows, index[g], gradient, g, levels.radius[index[g]], step, config.beta2,
                          adam_moments);
        });
        ++progress.groups_done;
    }
}

}  // namespace v3dg
