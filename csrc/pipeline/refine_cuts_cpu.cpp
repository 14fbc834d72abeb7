#include "pipeline/refine_cuts.h"

#include <algorithm>
#include <numeric>
#include <vector>

#include "base/parallel_for.h"
#include "pipeline/model.h"
#include "pipeline/refine_cuts_math.h"
#include "pipeline/render.h"

namespace v3dg {

namespace {

constexpr size_t kGaussiansAtOnce = 256, kViewsAtOnce = 32;

// Colour and alpha of one picture.
class Canvas {
  public:
    Picture<float> start(const Camera& camera) {
        width_ = static_cast<int>(camera.width);
        height_ = static_cast<int>(camera.height);
        values_.resize(4 * num_pixels());
        return {{0, 0, width_, height_}, {}, color(), alpha(), nullptr};
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

// Puts the slope of the loss in place of the picture.
void compare(const FitConfig& config, int samples, Canvas& picture, Canvas& target) {
    const auto width = static_cast<size_t>(picture.width()), height = static_cast<size_t>(picture.height());
    std::vector<double> loss_of_row(height, 0.0);
    parallel_for(height, 8, [&](size_t y) {
        for (size_t x = 0; x < width; ++x) {
            float* color = picture.color() + 3 * (y * width + x);
            float& alpha = picture.alpha()[y * width + x];
            for (int k = 0; k < 3; ++k) color[k] -= box_average(target.color(), width, 3, k, x, y, samples);
            alpha -= box_average(target.alpha(), width, 1, 0, x, y, samples);
            loss_of_row[y] += loss_of_pixel(config.loss, color, alpha);
        }
    });
    const float weight = weight_of_picture(std::accumulate(loss_of_row.begin(), loss_of_row.end(), 0.0),
                                           static_cast<double>(width * height));
    for (size_t i = 0; i < 3 * width * height; ++i)
        picture.color()[i] = l1_vjp(picture.color()[i], config.loss.l1 / 3 * weight);
    for (size_t i = 0; i < width * height; ++i)
        picture.alpha()[i] = l1_vjp(picture.alpha()[i], config.loss.alpha * weight);
}

}  // namespace

void refine_cuts(const FitConfig& config, const FitTarget& target, uint64_t target_count,
                 const CutRows& levels, const CutPictures& pictures, FitProgress& progress) {
    const GaussianRows<float>& rows = levels.rows;
    const size_t num = num_values(rows);
    std::vector<float> moments(2 * num * rows.size, 0.0f), shown_values, gradients;
    Workspace<float> of_target, of_cut;
    Canvas wanted, drawn;
    std::vector<CutView> views(kViewsAtOnce);
    for (size_t i = 0; i < static_cast<size_t>(config.steps) && !progress.cancel; ++i) {
        if (i % kViewsAtOnce == 0)
            parallel_for(kViewsAtOnce, 1, [&](size_t k) { views[k] = cut_view(pictures, i + k); });
        const CutView& view = views[i % kViewsAtOnce];
        const Camera& camera = view.camera;
        const int samples = view.samples;
        const Camera larger = enlarged(camera, samples);
        render<float>({{target.model,
                        0,
                        target_count,
                        view_of_world<float>(larger),
                        {target.filter_px2, target.antialiased}}},
                      pinhole_of<float>(larger), wanted.start(larger), false, of_target);

        const std::vector<uint32_t> index = gaussians_of(pictures.table, view);
        shown_values.resize(num * index.size());
        const GaussianRows<float> shown = rows_in(shown_values.data(), index.size(), rows.sh_degree);
        parallel_for(index.size(), kGaussiansAtOnce,
                     [&](size_t g) { copy_gaussian(rows, index[g], shown, g); });
        const Model<float> model(shown);
        const Draw<float> draw{&model.planes(),
                               0,
                               index.size(),
                               view_of_world<float>(camera),
                               {config.filter_px2, config.antialiased}};
        const Pinhole<float> pinhole = pinhole_of<float>(camera);
        const Picture<float> picture = drawn.start(camera);
        render<float>({draw}, pinhole, picture, true, of_cut);
        compare(config, samples, drawn, wanted);
        gradients.assign(num * index.size(), 0.0f);
        const GaussianRows<float> gradient = rows_in(gradients.data(), index.size(), rows.sh_degree);
        float d_background[3] = {};
        render_backward<float>(draw, pinhole, picture, {drawn.color(), drawn.alpha(), nullptr}, of_cut,
                               gradient, {}, d_background);

        const FitStep step = fit_step(config, static_cast<int>(i));
        const Moments kept{moments.data(), moments.data() + num * rows.size};
        parallel_for(index.size(), kGaussiansAtOnce, [&](size_t g) {
            if (index[g] < target_count) return;
            move_gaussian(rows, index[g], gradient, g, levels.radius[index[g]], step, config.beta2, kept);
        });
        ++progress.groups_done;
    }
}

}  // namespace v3dg
